"""What the command line shows: bars and notes on stderr, data on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC
from typing import Any

from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TaskID, TextColumn, TransferSpeedColumn
from rich.table import Table

from advtex_client.errors import ClientError
from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import TERMINAL, BatchView, JobState, JobView, ResultFile

LOG_LINES = 15  # of a failed job's log


class Display:
    """One command's output; with `as_json`, everything on stdout is JSON."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._said = ""
        self.notes = Console(stderr=True, highlight=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """Print a line for people, on stderr."""
        self.notes.print(text, markup=False)

    def data(self, value: BaseModel | Sequence[BaseModel] | dict[str, Any] | list[Any], text: str) -> None:
        """Print the command's result, on stdout: `value` as one line of JSON, or `text`."""
        print(json.dumps(_plain(value)) if self.as_json else text, flush=True)

    def failure(self, error: ClientError, exit_code: int) -> None:
        """Print an error, on stderr."""
        if self.as_json:
            body = {"code": error.code, "message": str(error), "exit_code": exit_code, "details": _plain(error.details)}
            print(json.dumps({"error": body}), file=sys.stderr, flush=True)
            return
        self.note(f"error: {error}")
        for line in finding_lines(error.details):
            self.note(f"  {line}")

    @contextmanager
    def bytes_bar(self, title: str) -> Iterator[BytesBar]:
        """Show a bar for an upload or a download."""
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
        with Progress(*columns, console=self.notes, transient=True, disable=not self._bars) as bars:
            yield BytesBar(bars, title)

    @contextmanager
    def job_bar(self) -> Iterator[JobBar]:
        """Show a bar for a job's stages and steps; a line per stage where stderr is no terminal."""
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"))
        with Progress(*columns, console=self.notes, transient=True, disable=not self._bars) as bars:
            yield JobBar(bars, self)

    @contextmanager
    def count_bar(self, title: str, total: int) -> Iterator[Callable[[], None]]:
        """Show a bar that moves by one whenever what this yields is called."""
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
        with Progress(*columns, console=self.notes, transient=True, disable=not self._bars) as bars:
            task = bars.add_task(title, total=total)
            yield lambda: bars.advance(task)

    @contextmanager
    def batch_bar(self) -> Iterator[Callable[[BatchView, Sequence[str]], None]]:
        """Show a bar of the jobs that have ended; a line per change where stderr is no terminal."""
        columns = (TextColumn("{task.description}"), BarColumn())
        with Progress(*columns, console=self.notes, transient=True, disable=not self._bars) as bars:
            task = bars.add_task("", total=None)

            def show(batch: BatchView, reasons: Sequence[str]) -> None:
                if self._bars:
                    ended = sum(count for state, count in batch.states.items() if state in TERMINAL)
                    bars.update(task, description=batch_line(batch, reasons), total=batch.jobs, completed=ended)
                else:
                    self.once(batch_line(batch.model_copy(update={"eta_seconds": None}), reasons))

            yield show

    def once(self, text: object) -> None:
        """Print a note, unless it was the last one too."""
        if str(text) != self._said:
            self._said = str(text)
            self.note(self._said)

    @property
    def _bars(self) -> bool:
        return self.notes.is_terminal


class BytesBar:
    """Shows bytes of one or several files."""

    def __init__(self, bars: Progress, title: str) -> None:
        self._bars = bars
        self._title = title
        self._tasks: dict[str, TaskID] = {}

    def upload(self, done: int, total: int) -> None:
        self._show(self._title, done, total)

    def download(self, file: ResultFile, done: int) -> None:
        self._show(file.name, done, file.size)

    def _show(self, name: str, done: int, total: int) -> None:
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total)
        self._bars.update(self._tasks[name], completed=done)


class JobBar:
    """Shows where a job stands."""

    def __init__(self, bars: Progress, display: Display) -> None:
        self._bars = bars
        self._display = display
        self._task = bars.add_task("", total=None, detail="")
        self._said = ""

    def show(self, job: JobView) -> None:
        progress = job.progress
        where = progress.stage if job.state is JobState.running and progress.stage else job.state
        if job.waiting_reason:
            where += f" ({job.waiting_reason})"
        if self._bars.disable and where != self._said:
            self._display.note(f"job {job.id}: {where}")
        self._said = where
        detail = f"{progress.step}/{progress.steps}" if progress.steps else ""
        if progress.eta_seconds is not None:
            detail += f"  about {duration(progress.eta_seconds)} left"
        total = progress.steps or None
        self._bars.update(self._task, description=where, total=total, completed=progress.step, detail=detail)

    def trouble(self, error: ClientError) -> None:
        self._display.note(f"{error}; the job is not affected, trying again")


def duration(seconds: float) -> str:
    """Return the time in words: `42 s`, `3 min 20 s`, `2 h 5 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def finding_lines(details: Iterable[ErrorDetail]) -> list[str]:
    """Return one line per finding: severity, place, what is wrong, what helps."""
    return [
        f"{d.severity}: {d.where + ': ' if d.where else ''}{d.message}{f' -> {d.remedy}' if d.remedy else ''}"
        for d in details
    ]


def job_lines(job: JobView) -> str:
    """Describe a job for people."""
    progress = job.progress
    lines = [f"job      {job.id}", f"state    {job.state}" + (f" (attempt {job.attempt})" if job.attempt > 1 else "")]
    if job.waiting_reason:
        lines.append(f"waits    {job.waiting_reason}")
    if job.deadline:
        due = f"{job.deadline.astimezone():%Y-%m-%d %H:%M}"
        lines.append(f"due      {due}{', late' if job.late else ''}")
    if job.label:
        lines.append(f"label    {job.label}")
    if progress.stage:
        steps = f", step {progress.step} of {progress.steps}" if progress.steps else ""
        lines.append(f"stage    {progress.stage}{steps}")
        if job.state is JobState.running and progress.eta_seconds is not None:
            lines.append(f"left     about {duration(progress.eta_seconds)} of this stage")
    if progress.losses:
        lines.append("losses   " + ", ".join(f"{name} {value:.4g}" for name, value in progress.losses.items()))
    lines += [f"note     {note}" for note in progress.notes]
    lines += [f"warning  {line}" for line in finding_lines(job.warnings)]
    if job.error:
        lines += [f"error    {job.error.message}", *(f"         {line}" for line in finding_lines(job.error.details))]
        lines += [f"log      {line}" for line in job.error.log_tail.splitlines()[-LOG_LINES:]]
    lines += result_lines(job.results)
    if job.expires_at:
        lines.append(f"kept until {job.expires_at.astimezone(UTC):%Y-%m-%d %H:%M} UTC")
    elif job.retention_seconds:
        lines.append(f"kept     {job.retention_seconds / 86400:.4g} days after its end")
    return "\n".join(lines)


def result_lines(files: Sequence[ResultFile]) -> list[str]:
    """List the files, those of a folder in one line."""
    folders: dict[str, list[int]] = {}
    for file in files:
        folder, slash, _ = file.name.partition("/")
        folders.setdefault(folder + slash, []).append(file.size)
    return [
        f"result   {name} ({f'{len(sizes)} files, ' if name.endswith('/') else ''}{sum(sizes)} bytes)"
        for name, sizes in folders.items()
    ]


def job_table(jobs: Sequence[JobView]) -> str:
    """List jobs as a table for people, newest first; the stage of one that waits is why it does."""
    table = Table(box=None, pad_edge=False)
    for title in ("job", "state", "stage", "created", "label"):
        table.add_column(title, overflow="fold")
    for job in jobs:
        progress = job.progress
        stage = f"{progress.stage} {progress.step}/{progress.steps}" if progress.steps else progress.stage
        table.add_row(job.id, job.state, job.waiting_reason or stage, f"{job.created_at:%Y-%m-%d %H:%M}", job.label)
    return _drawn(table)


def batch_line(batch: BatchView, reasons: Sequence[str] = ()) -> str:
    """Describe a batch: `night: 30 jobs, 12 succeeded, 18 queued, about 2 h left; waiting: no worker is running`."""
    parts = [f"{batch.jobs} jobs", *(f"{count} {state}" for state, count in sorted(batch.states.items()))]
    if batch.eta_seconds and not batch.finished:
        parts.append(f"about {duration(batch.eta_seconds)} left")
    if batch.paused:
        parts.append("paused")
    if batch.max_running is not None:
        parts.append(f"{batch.max_running} at a time")
    why = f"; waiting: {'; '.join(reasons)}" if reasons else ""
    return f"{batch.id}: {', '.join(parts)}{why}"


def batch_table(rows: Sequence[dict[str, Any]]) -> str:
    """List what the jobs of a batch came to, with a column per score."""
    scores = list(dict.fromkeys(name for row in rows for name in row.get("scores", {})))
    lines = []
    for row in rows:
        found = row.get("scores", {})
        shown = [f"{found[name]:.4g}" if name in found else "" for name in scores]
        spent = duration(row["seconds"]) if row["seconds"] else ""
        lines.append([row["label"] or row["job"], row["state"], str(row["steps"] or ""), spent, *shown])
    return drawn_table(["label", "state", "steps", "time", *scores], lines)


def drawn_table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Draw a table of text; the label and the state stand to the left, numbers to the right."""
    table = Table(box=None, pad_edge=False)
    for title in titles:
        table.add_column(title, overflow="fold", justify="left" if title in ("label", "state") else "right")
    for row in rows:
        table.add_row(*row)
    return _drawn(table)


def _drawn(table: Table) -> str:
    console = Console(width=160, highlight=False, markup=False, emoji=False)
    with console.capture() as captured:
        console.print(table)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
