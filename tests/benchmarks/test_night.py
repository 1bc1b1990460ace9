"""What the night chooses to show, from spans made up."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

sys.path.append(str(Path(__file__).parents[1] / "support"))

from collector import Received
from waterfall import draw_trace, worth_showing


def job(name: str, seconds: float, *, lost: bool) -> list[Received]:
    """Spans of a job that was done by its first or its second attempt; two scans of the same bytes have one upload."""

    def span(kind: str, start: float, end: float, parent: str, **told: object) -> Received:
        attributes = {f"advtex.{key}": value for key, value in told.items()}
        return Received("advtex-worker", kind, "t", f"{name}-{kind}-{start}", parent, start, end, False, attributes)

    submit = span("submit", 1.0, 1.1, "up", job=name)
    found = [submit, span("queue", 2.0, 3.0, submit.span, job=name, attempt=1)]
    if lost:
        found.append(span("lost", 3.0, 5.0, submit.span, job=name, attempt=1))
    attempt = span("attempt", 6.0, 6.0 + seconds, submit.span, job=name, attempt=1 + lost, state="succeeded")
    stage = span("stage optimization", 6.5, 6.0 + seconds / 2, attempt.span)
    return [*found, attempt, stage, span("webhook", 7.0 + seconds, 8.0 + seconds, submit.span)]


def test_the_trace_is_of_the_job_that_shows_most(tmp_path: Path) -> None:
    upload = Received("advtex-server", "upload", "t", "up", "", 0.0, 0.5, False, {})
    spans = [upload, *job("quick", 1.0, lost=False), *job("slow", 9.0, lost=True), *job("killed", 4.0, lost=True)]
    chosen, shown = worth_showing(spans)
    assert chosen == "killed"
    assert [span.name for span in shown[:2]] == ["upload", "submit"]
    assert sorted(span.span for span in shown[1:]) == sorted(span.span for span in job("killed", 4.0, lost=True))
    draw_trace(tmp_path / "trace.png", shown)
    assert cv2.imread(str(tmp_path / "trace.png")) is not None
    assert (tmp_path / "trace.png").stat().st_size < 150_000
