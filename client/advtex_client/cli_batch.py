"""`advtex-client batch`: many scans as one, from the submission to the table of scores."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from advtex_client._cli import (
    EXIT_CODES,
    ApiKey,
    AsJson,
    DeadlineOption,
    KeepOption,
    PriorityOption,
    Seconds,
    Url,
    command,
    deadline_given,
    job_options,
    retention,
)
from advtex_client._display import Display, batch_line, batch_table, finding_lines
from advtex_client.batch_comparison import compared, comparison_text
from advtex_client.batch_report import write_report
from advtex_client.batches import (
    BatchRun,
    remember,
    remembered,
    report_rows,
    result_rows,
    submit_batch,
    waiting_reasons,
)
from advtex_client.client import Client
from advtex_client.errors import (
    ApiError,
    ClientError,
    JobFailedError,
    NotFoundError,
    ScanRejectedError,
    WaitTimeoutError,
)
from advtex_client.manifests import read_items, read_options
from advtex_contract.jobs import BatchView, JobState
from advtex_options.flags import option_flags

POLL_SECONDS = 2.0

app = typer.Typer(help="Many scans as one batch.", no_args_is_help=True)

BatchName = Annotated[str, typer.Argument(help="the batch's id", metavar="BATCH")]
Wait = Annotated[bool, typer.Option("--wait", help="until every job has ended; then a table with the scores")]


@app.command()
@option_flags
def submit(
    scans: Annotated[
        Path, typer.Argument(exists=True, readable=True, help="a folder of scans, or a manifest (.csv, .jsonl)")
    ],
    given: dict[str, Any],
    batch: Annotated[str | None, typer.Option("--id", help="the batch's id; else made of the name of SCANS")] = None,
    by_reference: Annotated[
        bool, typer.Option("--by-reference", help="send nothing: the server reads the same paths")
    ] = False,
    priority: PriorityOption = 0,
    keep_days: KeepOption = None,
    deadline: DeadlineOption = None,
    options_file: Annotated[
        Path | None, typer.Option("--options", help="a .toml or .json file of options; flags go before what it says")
    ] = None,
    max_running: Annotated[
        int | None, typer.Option("--max-running", min=1, help="how many of the batch's jobs run at a time")
    ] = None,
    wait: Wait = False,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Submit every scan of a folder or manifest. Run again, it goes on: no scan is sent or queued twice.

    A folder may be ScanNet's, with its scenes in `scans`. A manifest has the columns path, label, priority, keep_days
    and deadline, one for each option by its name (preset, size ...), and options (a JSON object of them); paths are
    relative to it, or file:// and s3:// URLs that the server can read.
    """
    with command(as_json) as display, Client(url, api_key) as client:
        options = job_options((read_options(options_file) if options_file else {}) | given)
        run = BatchRun(
            place=scans.absolute(),
            by_reference=by_reference,
            options=options,
            priority=priority,
            retention_seconds=retention(keep_days),
            deadline=deadline_given(deadline),
        )
        name = batch or _id_from(scans)
        if max_running is not None:
            _limit(client, name, max_running)
        _submit(client, display, name, run, wait, timeout)


@app.command()
def resume(
    batch: BatchName,
    wait: Wait = False,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Let jobs of a paused batch begin again, and go on with a `batch submit` that was broken off on this computer."""
    with command(as_json) as display, Client(url, api_key) as client:
        resumed = _resumed(client, batch)
        try:
            run = remembered(client.config.url, batch)
        except ClientError:
            if resumed is None:
                raise
            display.data(resumed, batch_line(resumed))
            return
        _submit(client, display, batch, run, wait, timeout)


@app.command()
def status(
    batch: BatchName,
    wait: Wait = False,
    table: Annotated[bool, typer.Option("--table", help="one line per job, with its scores")] = False,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Say how many jobs are in which state, and how long the rest takes."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.get_batch(batch)
        if wait:
            _finish(client, display, view, timeout)
        elif table:
            _show_table(client, display, view)
        else:
            display.data(view, batch_line(view, () if display.as_json else waiting_reasons(client, view)))


@app.command()
def report(
    batch: BatchName,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the page, .html; else BATCH.html")] = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Write a page that shows what a batch came to: scores, pictures, times, GPU seconds, and why jobs failed.

    The page needs no other file; the same as .csv and .json is written beside it.
    """
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.get_batch(batch)
        rows, thumbnails = list[dict[str, Any]](), dict[str, bytes]()
        with display.count_bar(f"batch {batch}", view.jobs) as advance:
            for row in report_rows(client, batch, thumbnails):
                advance()
                rows.append(row)
        written = [str(path) for path in write_report(output or Path(f"{batch}.html"), view, rows, thumbnails)]
        display.data({"files": written}, "\n".join(written))


@app.command()
def compare(
    first: Annotated[str, typer.Argument(help="the batch's id", metavar="FIRST")],
    second: Annotated[str, typer.Argument(help="another's, of the same scans", metavar="SECOND")],
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Compare two batches scan by scan, by label: states, GPU time, and how much the scores differ (SECOND - FIRST).

    Ends with the mean and the worst difference of each score; exit code 5 if a job of either did not succeed.
    """
    with command(as_json) as display, Client(url, api_key) as client:
        for batch in (first, second):
            client.get_batch(batch)
        found = compared(report_rows(client, first), report_rows(client, second))
        display.data(found, comparison_text(found))
        if any(state != JobState.succeeded for scan in found["scans"] for state in scan["states"]):
            raise typer.Exit(EXIT_CODES[JobFailedError])


@app.command()
def cancel(batch: BatchName, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Cancel every job of a batch that has not ended."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.cancel_batch(batch)
        display.data(view, batch_line(view))


@app.command()
def pause(batch: BatchName, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Keep every job of a batch that waits waiting, until `batch resume`; what runs goes on."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.pause_batch(batch)
        display.data(view, batch_line(view))


@app.command("retry-failed")
def retry_failed(batch: BatchName, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Queue every failed job of a batch again; each goes on from its newest checkpoint."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.retry_batch(batch)
        display.data(view, batch_line(view))


@app.command("list")
def list_(
    limit: Annotated[int, typer.Option(min=1, help="show at most this many")] = 50,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """List batches, newest first."""
    with command(as_json) as display, Client(url, api_key) as client:
        found = [batch for batch, _ in zip(client.list_batches(page=min(limit, 100)), range(limit), strict=False)]
        display.data(found, "\n".join(map(batch_line, found)) or "no batches")


def _submit(client: Client, display: Display, batch_id: str, run: BatchRun, wait: bool, timeout: float | None) -> None:
    items = read_items(run.place, run.options, run.priority, run.by_reference, run.retention_seconds, run.deadline)
    remember(client.config.url, batch_id, run)
    display.note(f"batch {batch_id}: {len(items)} scans; broken off, `advtex-client batch resume {batch_id}` goes on")
    refused = 0
    with display.count_bar(f"batch {batch_id}", len(items)) as advance:
        for outcome in submit_batch(client, batch_id, items, on_full=display.once):
            advance()
            if outcome.error is not None:
                refused += 1
                display.note(f"{outcome.item.label}: {outcome.error}")
                for line in finding_lines(outcome.error.details):
                    display.note(f"  {line}")
    if refused == len(items):
        raise ScanRejectedError(f"none of the {refused} scans was accepted; the reasons are above")
    view = client.get_batch(batch_id)
    if wait:
        _finish(client, display, view, timeout)
    else:
        display.data(view, batch_line(view))
    if refused:
        display.note(f"{refused} of {len(items)} scans were not accepted; mend them and run the same command again")
        raise typer.Exit(EXIT_CODES[ScanRejectedError])


def _resumed(client: Client, batch_id: str) -> BatchView | None:
    """Resume a batch that is paused. Return None for one that is not, or is not there yet."""
    try:
        return client.resume_batch(batch_id) if client.get_batch(batch_id).paused else None
    except NotFoundError:
        return None


def _limit(client: Client, batch_id: str, max_running: int) -> None:
    try:
        client.limit_batch(batch_id, max_running)
    except ApiError as error:
        if error.status not in (404, 405):
            raise
        remedy = "upgrade it, or leave --max-running out"
        raise ClientError(f"this server is from before batches could be limited; {remedy}") from error


def _finish(client: Client, display: Display, view: BatchView, timeout: float | None) -> None:
    """Wait for the end, show the table; JobFailedError's exit code if a job did not succeed."""
    started = time.monotonic()
    with display.batch_bar() as show:
        while not view.finished:
            running = view.states.get(JobState.running)
            show(view, () if running else waiting_reasons(client, view))
            if timeout is not None and time.monotonic() - started > timeout:
                raise WaitTimeoutError(f"batch {view.id} did not end within {timeout:g} s; it goes on")
            time.sleep(POLL_SECONDS)
            view = client.get_batch(view.id)
    _show_table(client, display, view)
    if set(view.states) != {JobState.succeeded}:
        raise typer.Exit(EXIT_CODES[JobFailedError])


def _show_table(client: Client, display: Display, view: BatchView) -> None:
    rows = list(result_rows(client, view.id))
    display.data({"batch": view.model_dump(mode="json"), "jobs": rows}, f"{batch_table(rows)}\n{batch_line(view)}")


def _id_from(scans: Path) -> str:
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", scans.resolve().stem if scans.is_file() else scans.resolve().name)
    name = name.strip("._-")[:100]
    if not name:
        raise ClientError(f"{scans} has no name that a batch could have; choose one with --id")
    return name
