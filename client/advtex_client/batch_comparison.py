"""Two batches of the same scans beside each other, by the scans' labels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from advtex_client._display import drawn_table, duration
from advtex_contract.jobs import JobState

LESS_IS_BETTER = ("lpips", "lpips_full", "band_error", "sliced_wasserstein")
MORE_IS_BETTER = ("psnr", "ssim")
ALONE, WHICH = ([JobState.succeeded, None], [None, JobState.succeeded]), ("first", "second")
NAMED = 3

Row = Mapping[str, Any]


def compared(first: Iterable[Row], second: Iterable[Row]) -> dict[str, Any]:
    """Compare rows of two batches, as `batches.report_rows` yields them.

    Return `scans`: by label both states and GPU seconds, None where one batch does not have it, and the differences of
    what both have, second minus first; `scores` and `gpu_seconds`: the mean of these differences over the scans, and
    the worst with its label. Of jobs with the same label the n-th in both are compared. For scores of which neither
    less nor more is better, such as ratios that are best at 1, the worst is the largest change.
    """
    mine, theirs = _by_label(first), _by_label(second)
    scans = [_compared_scan(key[0], mine.get(key), theirs.get(key)) for key in sorted(mine.keys() | theirs.keys())]
    names = dict.fromkeys(name for scan in scans for name in scan["scores"])
    scores = {name: _summary(name, [(scan["scores"].get(name), scan["label"]) for scan in scans]) for name in names}
    spent = [(scan["gpu_seconds_difference"], scan["label"]) for scan in scans]
    return {"scans": scans, "scores": scores, "gpu_seconds": _summary("gpu_seconds", spent)}


def comparison_text(found: Mapping[str, Any]) -> str:
    """Describe what `compared` returns, for people: a table, then a line per score. Scans that only one batch has are
    counted, unless they have not succeeded."""
    names = list(found["scores"])
    lines = []
    alone = [[scan["label"] for scan in found["scans"] if scan["states"] == pair] for pair in ALONE]
    for scan in found["scans"]:
        if scan["states"] in ALONE:
            continue
        states = scan["states"]
        state = states[0] if states[0] == states[1] else f"{states[0] or 'none'} -> {states[1] or 'none'}"
        spent = " -> ".join("" if seconds is None else duration(seconds) for seconds in scan["gpu_seconds"])
        lines.append([scan["label"], state, spent, *(_signed(scan["scores"].get(name)) for name in names)])
    table = drawn_table(["label", "state", "GPU time", *names], lines)
    told = {**found["scores"], "GPU seconds": found["gpu_seconds"]}
    means = [
        f"{name}: mean {_signed(about['mean'])} over {about['scans']} scans, worst {_signed(about['worst'])} "
        f"({about['label']})"
        for name, about in told.items()
        if about is not None
    ]
    return "\n".join(
        [table, *(_counted(labels, which) for labels, which in zip(alone, WHICH, strict=True) if labels), *means]
    )


def _counted(labels: Sequence[str], which: str) -> str:
    few = ", ".join(labels[:NAMED]) + (" ..." if len(labels) > NAMED else "")
    return f"only in the {which}, and succeeded: {len(labels)} ({few})"


def _by_label(rows: Iterable[Row]) -> dict[tuple[str, int], Row]:
    seen: dict[str, int] = defaultdict(int)
    found = {}
    for row in rows:
        label = row["label"] or row["job"]
        found[label, seen[label]] = row
        seen[label] += 1
    return found


def _compared_scan(label: str, first: Row | None, second: Row | None) -> dict[str, Any]:
    both = (first or {}, second or {})
    before, after = (row.get("gpu_seconds") for row in both)
    scores = [row.get("scores", {}) for row in both]
    return {
        "label": label,
        "states": [row.get("state") for row in both],
        "gpu_seconds": [before, after],
        "gpu_seconds_difference": None if before is None or after is None else round(after - before, 1),
        "scores": {name: scores[1][name] - scores[0][name] for name in scores[0] if name in scores[1]},
    }


def _summary(name: str, differences: Iterable[tuple[float | None, str]]) -> dict[str, Any] | None:
    known = [(difference, label) for difference, label in differences if difference is not None]
    if not known:
        return None
    worse = -1.0 if name in MORE_IS_BETTER else 1.0
    directed = name in (*LESS_IS_BETTER, *MORE_IS_BETTER, "gpu_seconds")
    worst, label = max(known, key=lambda pair: worse * pair[0] if directed else abs(pair[0]))
    mean = sum(difference for difference, _ in known) / len(known)
    return {"mean": mean, "scans": len(known), "worst": worst, "label": label}


def _signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.4g}"
