"""What a constant brings to scans that had no say in it: each scan gets the value that all the others choose.

    python tests/benchmarks/leave_one_out.py RESULTS.json --vary variant --now "the whole" [--values VALUE …]
        [--score lpips_corrected] [--where size=640x480 …]

RESULTS.json holds the cells of a benchmark on real scans; --vary names the setting whose values are candidates, such as
`variant` of parts.json or `method` of scans.json. The others choose the least geometric mean of the score. Prints a
table, the mean gain over the value of --now, the worst loss, and what all scans together choose.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness import markdown_table

TOLERATED_LOSS = 0.01
"""Of a scan's score: what harms one by more stays out, or adapts by a measurement of the scan."""


@dataclass(frozen=True)
class Choice:
    """What the other scans choose for a scan, and by which share its score is then less than it is now."""

    scan: str
    value: str
    gain: float


def leave_one_out(scores: Mapping[str, Mapping[str, float]], now: str) -> list[Choice]:
    """A choice per scan. scores: per scan those of each value, above 0 and less is better. now: the value to beat.

    Equal values lose to `now`, and else to those before them. Raises ValueError for fewer than two scans, and for a
    scan that lacks a value.
    """
    if len(scores) < 2:
        raise ValueError(f"{len(scores)} scans: at least 2 are needed, one to choose for the other")
    values = dict.fromkeys([now, *(value for row in scores.values() for value in row)])
    for scan, row in scores.items():
        if lacking := [value for value in values if value not in row]:
            raise ValueError(
                f"{scan} has no score for {', '.join(lacking)}; run the benchmark, or leave that value out"
            )
    found = []
    for scan, row in scores.items():
        value = best([other for name, other in scores.items() if name != scan], values)
        found.append(Choice(scan, value, 1 - row[value] / row[now]))
    return found


def best(rows: Sequence[Mapping[str, float]], values: Iterable[str]) -> str:
    """The first of the values with the least geometric mean."""
    return min(values, key=lambda value: statistics.geometric_mean(row[value] for row in rows))


def format_choices(scores: Mapping[str, Mapping[str, float]], now: str) -> str:
    """The table and the lines below it."""
    choices = leave_one_out(scores, now)
    rows = [
        [choice.scan, choice.value, scores[choice.scan][now], scores[choice.scan][choice.value], _percent(choice.gain)]
        for choice in choices
    ]
    worst = min(choices, key=lambda choice: choice.gain)
    lines = [
        markdown_table(["scan", "the others choose", "now", "with it", "gain"], rows),
        f"Mean gain on the scans that did not choose: {_percent(statistics.mean(choice.gain for choice in choices))}.",
        f"Worst: {_percent(worst.gain)}, {worst.scan}."
        + (" It stays out, or adapts by a measurement of the scan." if worst.gain < -TOLERATED_LOSS else ""),
        f"All scans together choose {best(list(scores.values()), [now, *next(iter(scores.values()))])}.",
    ]
    return "\n".join(lines)


def _percent(share: float) -> str:
    return f"{100 * share:+.2f} %"


def scores_of(
    cells: Sequence[Mapping[str, Any]], vary: str, score: str, values: Sequence[str], where: Mapping[str, str]
) -> dict[str, dict[str, float]]:
    """Per scan the score of each value of the setting `vary`, of cells whose settings are those of `where`.

    values: the candidates; all that there are, if empty. Raises ValueError where two cells are meant.
    """
    found: dict[str, dict[str, float]] = {}
    for cell in cells:
        settings = {name: str(value) for name, value in cell["settings"].items()}
        if "scan" not in settings or vary not in settings or not where.items() <= settings.items():
            continue
        scan, value = settings["scan"], settings[vary]
        if score not in cell["scores"] or (values and value not in values):
            continue
        row = found.setdefault(scan, {})
        if value in row:
            raise ValueError(f"{scan}, {value}: there are several cells; tell them apart with --where")
        row[value] = float(cell["scores"][score])
    return found


def main(line: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="JSON file of a benchmark")
    parser.add_argument("--vary", required=True, help="setting whose values are the candidates")
    parser.add_argument("--now", required=True, help="the value to beat")
    parser.add_argument("--values", nargs="+", default=[], help="candidates; default: all that there are")
    parser.add_argument("--score", default="lpips_corrected", help="less is better")
    parser.add_argument("--where", nargs="+", default=[], metavar="NAME=VALUE", help="settings of the cells")
    arguments = parser.parse_args(line)
    where = {name: value for name, _, value in (pair.partition("=") for pair in arguments.where)}
    values = [arguments.now, *arguments.values] if arguments.values else []
    try:
        cells = json.loads(arguments.results.read_text())["cells"]
        scores = scores_of(cells, arguments.vary, arguments.score, values, where)
        print(format_choices(scores, arguments.now))
    except (OSError, ValueError) as error:
        raise SystemExit(f"{arguments.results}: {error}") from error


if __name__ == "__main__":
    main()
