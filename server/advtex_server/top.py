"""`advtex-server top`: the fleet in a terminal, drawn again every few seconds."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence

from redis import RedisError
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text
from sqlalchemy.exc import SQLAlchemyError

from advtex_contract.jobs import TERMINAL, JobState
from advtex_contract.stages import STAGE_LABELS
from advtex_server.fleet import FleetView, Work, WorkerView

BARS = " ▁▂▃▄▅▆▇█"
GIB = 1 << 30
NAMED = 5  # owners, and causes of failures
ID_WIDTH = 28
WIDE = 110  # columns of a terminal that has room for everything

Row = Sequence[Text | str]


def show(look: Callable[[], FleetView], seconds: float, console: Console, *, once: bool) -> None:
    """Until Ctrl-C, or one picture. While the database does not answer, the last picture stays."""
    if once:
        console.print(picture(look(), console.width, None))
        return
    with Live(console=console, screen=True, auto_refresh=False) as live:
        body: RenderableType = ""
        while True:
            try:
                body = picture(look(), console.width, console.height)
                live.update(body, refresh=True)
            except (SQLAlchemyError, RedisError, OSError) as error:
                trouble = Text(f"no answer: {str(error).splitlines()[0]}", style="bold red", no_wrap=True)
                live.update(Group(trouble, body), refresh=True)
            time.sleep(seconds)


def picture(view: FleetView, width: int, height: int | None) -> RenderableType:
    """width, height: of the terminal in characters; None for as many lines as it takes. Workers that find no room are
    counted only."""
    below = [_queue(view), _last_day(view), _failures(view)]
    taken = 4 + sum(table.row_count + 2 for table in below if table.row_count)  # two lines, a header, and one below
    rows = _worker_rows(view)
    room = len(rows) if height is None else max(2, height - taken - 1)
    parts: list[RenderableType] = [_headline(view), _trouble(view), _workers(rows, room, width)]
    for table in below:
        parts += ["", table] if table.row_count else []
    return Group(*parts)


def _headline(view: FleetView) -> Text:
    parts = [f"{sum(line.jobs for line in view.queue)} waiting", f"{view.states.get(JobState.running, 0)} running"]
    if view.states.get(JobState.checking):
        parts.append(f"{view.states[JobState.checking]} being checked")
    work = [*(found.work for found in view.workers or () if found.work is not None), *view.elsewhere]
    parts.append(f"{sum(one.steps_per_second or 0.0 for one in work):.1f} steps/s")
    clock = time.strftime("%H:%M:%S  ", time.localtime(view.at))
    return Text.assemble(("advtex  ", "bold"), clock, ", ".join(parts), no_wrap=True)


def _trouble(view: FleetView) -> Text:
    told = ""
    if view.workers is None:
        told = "Redis does not answer: workers are not known"
    elif view.without_worker:
        told = f"{view.without_worker} of the jobs that wait fit no living worker"
    return Text(told, style="bold red", no_wrap=True)


def _worker_rows(view: FleetView) -> list[tuple[bool, Row]]:
    """Whether it is at work, and its line."""
    living = sorted(view.workers or [], key=lambda found: (found.memory_gib, not found.busy, found.name))
    rows: list[tuple[bool, Row]] = [
        (found.busy, (*_worker(found), *_work(found.work, busy=found.busy))) for found in living
    ]
    rows += [(True, ("?", str(work.memory_gib), "", *_work(work, busy=True))) for work in view.elsewhere]
    return rows


def _worker(found: WorkerView) -> Row:
    gpu = ""
    if found.gpu is not None:
        busy = "" if found.gpu.utilization is None else f"{found.gpu.utilization:.0%} "
        gpu = f"{busy}{found.gpu.memory_used_bytes / GIB:.1f}/{found.gpu.memory_bytes / GIB:.0f}G"
    return found.name, str(found.memory_gib), gpu


def _work(work: Work | None, *, busy: bool) -> Row:
    if work is None:
        return "", "", Text("at work" if busy else "idle", style="dim"), "", ""
    stage = Text(work.pauses, style="yellow") if work.pauses else STAGE_LABELS.get(work.stage, work.stage) or "starting"
    name = f"{work.label or work.job[-6:]}{f' ({work.attempt})' if work.attempt > 1 else ''}"
    done = f"{work.step / work.steps:.0%}" if work.steps else ""
    return Text(name), Text(work.owner), stage, done, _time(work.eta_seconds)


def _workers(rows: Sequence[tuple[bool, Row]], room: int, width: int) -> RenderableType:
    wide = width >= WIDE
    table = _table()
    table.add_column("worker", no_wrap=True, max_width=28 if wide else 18)
    table.add_column("GiB", no_wrap=True, justify="right")
    table.add_column("GPU", no_wrap=True, justify="right", max_width=15 if wide else 4)
    table.add_column("job", no_wrap=True, max_width=22 if wide else 12)
    table.add_column("owner", no_wrap=True, max_width=14 if wide else 8)
    table.add_column("stage", no_wrap=True, max_width=width - 103 if wide and width > 125 else 22 if wide else 14)
    table.add_column("done", no_wrap=True, justify="right")
    table.add_column("left", no_wrap=True, justify="right")
    for _, row in rows[:room]:
        table.add_row(*row)
    if left := Counter("at work" if busy else "idle" for busy, _ in rows[room:]):
        table.add_row(f"{left.total()} more", "", "", ", ".join(f"{number} {what}" for what, number in left.items()))
    return table if rows else Text("no worker is running", style="yellow")


def _queue(view: FleetView) -> Table:
    table = _table("waits", "jobs", "oldest", "by GiB", right=("jobs", "oldest"))
    for line in view.queue[:NAMED]:
        classes = ", ".join(f"{gib}: {jobs}" for gib, jobs in sorted(line.by_memory_gib.items()))
        table.add_row(Text(line.owner), str(line.jobs), _time(line.oldest_seconds), classes)
    if rest := view.queue[NAMED:]:
        table.add_row(f"{len(rest)} more", str(sum(line.jobs for line in rest)), "", "")
    return table


def _last_day(view: FleetView) -> Table:
    table = _table("ended", "jobs", f"by hour of the last {len(view.hours)}", right=("jobs",))
    for state in sorted(TERMINAL):
        counts = [hour.states.get(state, 0) for hour in view.hours]
        if any(counts):
            table.add_row(state.value, str(sum(counts)), _bars(counts))
    return table


def _bars(counts: Sequence[int]) -> str:
    most = max(counts)
    return "".join(BARS[-(-count * (len(BARS) - 1) // most)] for count in counts)


def _failures(view: FleetView) -> Table:
    table = _table()
    table.add_column("failed", no_wrap=True, min_width=20)
    table.add_column("the newest of them", no_wrap=True, min_width=ID_WIDTH)
    table.add_column("", no_wrap=True)
    for cause in view.failures[:NAMED]:
        newest = cause.newest[0]
        table.add_row(f"{cause.cause}: {cause.jobs}", newest.id, Text(newest.message))
    return table


def _table(*names: str, right: Sequence[str] = ()) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for name in names:
        table.add_column(name, no_wrap=True, justify="right" if name in right else "left")
    return table


def _time(seconds: float | None) -> str:
    if seconds is None:
        return ""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172_800 else f"{seconds / 86_400:.0f} d"
