"""A trace as a waterfall: a line per span, from its start to its end, children below their parents."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from collector import Received
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLORS = {"advtex-server": "#4c78a8", "advtex-dispatcher": "#9467bd", "advtex-worker": "#59a14f"}
FAILED = "#c0392b"
LEAST_SHARE = 0.004  # of the width, so that short spans are seen
LATE_SHARE = 0.6  # what begins after that has its text on its left

Lines = list[tuple[Received, int]]
"""Spans in the order in which they are drawn, and how deep each lies."""


def worth_showing(spans: Sequence[Received]) -> tuple[str, list[Received]]:
    """-> the job whose trace shows most, and its spans, the upload's first: one that lost a worker and was done by the
    next, with a webhook; of those the one that took least time. Raises ValueError where no job was attempted."""
    jobs = {span.parent: str(span.attributes["advtex.job"]) for span in spans if span.name == "attempt"}
    traces = {job: _family(spans, submit) for submit, job in jobs.items()}

    def rank(job: str) -> tuple[int, float]:
        names = {span.name for span in traces[job]}
        done = any(span.attributes.get("advtex.state") == "succeeded" for span in traces[job])
        told = sum(name in names for name in ("upload", "queue", "lost", "webhook")) + done
        return -told, max(span.end for span in traces[job]) - min(span.start for span in traces[job])

    chosen = min(jobs.values(), key=rank)
    return chosen, traces[chosen]


def draw_trace(path: Path, spans: Sequence[Received]) -> None:
    """A PNG of a job's spans: on the left all of its time, on the right that of its last attempt."""
    began = min(span.start for span in spans)
    last = max((span for span in spans if span.name == "attempt"), key=lambda span: span.start)
    lines = list(_in_order(spans))
    figure = Figure(figsize=(13, 0.9 + 0.24 * len(lines)), layout="constrained")
    whole, zoomed = figure.subplots(1, 2, sharey=True)
    _draw(whole, lines, began, began, max(span.end for span in spans))
    _draw(zoomed, [line for line in lines if line[0].end > last.start], began, last.start, last.end, lines)
    whole.set_yticks(range(len(lines)), ["    " * depth + span.name for span, depth in lines], fontsize=8, ha="left")
    whole.tick_params(axis="y", length=0, pad=115)
    whole.invert_yaxis()
    zoomed.tick_params(axis="y", length=0)
    zoomed.set_title("the last attempt", fontsize=8)
    for name, color in {**COLORS, "failed": FAILED}.items():
        whole.barh(0, 0, color=color, label=name)
    figure.legend(loc="outside upper left", ncols=4, fontsize=8, frameon=False)
    figure.savefig(path, dpi=100)


def _draw(axes: Axes, lines: Lines, began: float, start: float, end: float, among: Lines | None = None) -> None:
    """Those of a stretch of time, in seconds since `began`, each in its row of `among`."""
    width = end - start
    rows = {span.span: row for row, (span, _) in enumerate(among or lines)}
    for span, _ in lines:
        seconds, left = span.end - span.start, max(span.start, start) - began
        color = FAILED if span.failed else COLORS.get(span.service, "#888888")
        shown = max(min(span.end, end) - began - left, LEAST_SHARE * width)
        axes.barh(rows[span.span], shown, left=left, color=color, height=0.7)
        attempt = span.attributes.get("advtex.attempt")
        told = _duration(seconds) + ("" if attempt is None else f", attempt {attempt}")
        late = left + began - start > LATE_SHARE * width
        place = left - 0.01 * width if late else left + shown + 0.01 * width
        inside = shown > (1 - LATE_SHARE) * width
        place, late = (left + 0.01 * width, False) if inside else (place, late)
        axes.text(
            place,
            rows[span.span],
            told,
            va="center",
            ha="right" if late else "left",
            fontsize=7,
            color="white" if inside else "#555555",
        )
    axes.set_xlim(start - began - 0.01 * width, end - began + 0.01 * width)
    axes.set_xlabel("seconds since the upload began", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _family(spans: Sequence[Received], submit: str) -> list[Received]:
    """The span `submit`, what it comes from, and all that comes from it."""
    by_id = {span.span: span for span in spans}
    found = []
    above = submit
    while above in by_id:
        found.insert(0, by_id[above])
        above = by_id[above].parent
    below = [submit]
    while below:
        children = [span for span in spans if span.parent in below]
        found += children
        below = [span.span for span in children]
    return found


def _in_order(spans: Sequence[Received], parent: str | None = None, depth: int = 0) -> Iterator[tuple[Received, int]]:
    known = {span.span for span in spans}
    mine = [span for span in spans if (span.parent not in known if parent is None else span.parent == parent)]
    for span in sorted(mine, key=lambda span: span.start):
        yield span, depth
        yield from _in_order(spans, span.span, depth + 1)


def _duration(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"
