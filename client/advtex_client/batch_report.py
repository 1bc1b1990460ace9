"""The report of a batch: one page that needs nothing else, and the same as CSV and JSON beside it."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from advtex_client._display import batch_line, duration
from advtex_client.errors import ClientError
from advtex_contract.jobs import BatchView

COLUMNS = ("label", "job", "state", "attempt", "steps", "gpu_seconds", "elapsed_seconds", "late", "reason")
SHOWN = ("label", "state", "attempt", "steps", "gpu_seconds", "elapsed_seconds", "late")
NAMED = 20  # jobs of each reason
ALWAYS_SHOWN = ("label", "state", "gpu_seconds")
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # how cells begin that spreadsheets would compute
NOTE = (
    "GPU seconds are what the stages of all attempts took on their workers; work that was lost with a worker is not in "
    "them. Elapsed is from the submission to the end. Scores are means over the views that were held out."
)

Row = Mapping[str, Any]


def score_names(rows: Sequence[Row]) -> list[str]:
    """Return the names of all scores that any row has, as they come."""
    return list(dict.fromkeys(name for row in rows for name in row.get("scores", {})))


def write_report(path: Path, batch: BatchView, rows: Sequence[Row], thumbnails: Mapping[str, bytes]) -> list[Path]:
    """Write `path` (.html), and .csv and .json beside it. Return all three. Raises ClientError.

    rows: as `batches.result_rows` yields them. thumbnails: JPEGs by the job's id.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise ClientError(f"{path} does not end in .html; the report is a page, with .csv and .json beside it")
    texts = {
        path: _page(batch, rows, thumbnails),
        path.with_suffix(".csv"): _csv(rows),
        path.with_suffix(".json"): json.dumps({"batch": batch.model_dump(mode="json"), "jobs": rows}, indent=1) + "\n",
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for place, text in texts.items():
            place.write_bytes(text.encode())
    except OSError as error:
        raise ClientError(f"the report cannot be written: {error}; give another place with -o") from error
    return list(texts)


def _cells(row: Row, scores: Sequence[str]) -> list[Any]:
    """Return the row as the CSV shows it, None for what it does not have."""
    return [*(row.get(name) for name in COLUMNS), *(row.get("scores", {}).get(name) for name in scores)]


def _csv(rows: Sequence[Row]) -> str:
    scores = score_names(rows)
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow([*COLUMNS, *scores])
    writer.writerows([_harmless(cell) for cell in _cells(row, scores)] for row in rows)
    return file.getvalue()


def _harmless(cell: Any) -> Any:
    """Keep a spreadsheet from computing what a user has written; the JSON has it as it is."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(FORMULA) else cell


def _page(batch: BatchView, rows: Sequence[Row], thumbnails: Mapping[str, bytes]) -> str:
    scores = score_names(rows)
    names = [name for name in SHOWN if name in ALWAYS_SHOWN or any(row.get(name) for row in rows)] + scores
    heads = [f'<th scope="col"><button>{escape(name.replace("_", " "))}</button></th>' for name in names]
    means = score_means(rows)
    mean = "".join(f'<td class="number">{means[name]:.4g}</td>' if name in means else "<td></td>" for name in names[1:])
    template = Template(files("advtex_client").joinpath("batch_report.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=escape(f"Batch {batch.id}"),
        summary=escape(f"{batch_line(batch)}; {duration(sum(row['gpu_seconds'] for row in rows))} of GPU time"),
        reasons=_reasons(rows),
        head='<th scope="col">picture</th>' + "".join(heads),
        mean=f'<tr><td></td><th scope="row">mean</th>{mean}</tr>' if means else "",
        rows="\n".join(_line(row, names, thumbnails.get(row["job"])) for row in rows),
        note=escape(NOTE),
    )


def _reasons(rows: Sequence[Row]) -> str:
    """Show why jobs failed or wait, each reason once with those that have it."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.get("reason"):
            found.setdefault((row["state"], row["reason"]), []).append(row)
    items = []
    for (state, reason), having in found.items():
        links = ", ".join(
            f'<a href="#{escape(row["job"])}">{escape(row["label"] or row["job"])}</a>' for row in having[:NAMED]
        )
        if len(having) > NAMED:
            links += f" and {len(having) - NAMED} more"
        told = f'<span class="state {escape(state)}">{escape(state)}</span>: {links}'
        items.append(f'<li>{told}<p class="reason">{escape(reason)}</p></li>')
    return f"<h2>Failed, or waiting</h2>\n<ul>{''.join(items)}</ul>" if items else ""


def score_means(rows: Sequence[Row]) -> dict[str, float]:
    """Return the mean of each score over the rows that have it."""
    found = {name: [row["scores"][name] for row in rows if name in row.get("scores", {})] for name in score_names(rows)}
    return {name: sum(values) / len(values) for name, values in found.items()}


def _line(row: Row, names: Sequence[str], thumbnail: bytes | None) -> str:
    label, job = escape(row["label"] or row["job"]), escape(row["job"])
    picture = ""
    if thumbnail is not None:
        data = base64.b64encode(thumbnail).decode()
        picture = f'<img alt="{label}" decoding="async" src="data:image/jpeg;base64,{data}">'
    name = f'<th scope="row" data-value="{label}">{label}<br><code>{job}</code></th>'
    values = {**row, **row.get("scores", {})}
    cells = "".join(_cell(name, values.get(name)) for name in names[1:])
    return f'<tr id="{job}"><td>{picture}</td>{name}{cells}</tr>'


def _cell(name: str, value: Any) -> str:
    if isinstance(value, bool):
        value = "late" if value else ""
    if isinstance(value, (int, float)):
        shown = duration(value) if name.endswith("_seconds") else f"{value:.4g}" if isinstance(value, float) else value
        return f'<td class="number" data-value="{value}">{shown}</td>'
    text = escape(value or "")
    return f'<td class="{name} {text}" data-value="{text}">{text}</td>'
