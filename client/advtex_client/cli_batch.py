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
    KeepOption,
    PriorityOption,
    Seconds,
    Url,
    command,
    job_options,
    retention,
)
from advtex_client._display import Display, batch_line, batch_table, finding_lines
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
from advtex_client.errors import ClientError, JobFailedError, ScanRejectedError, WaitTimeoutError
from advtex_client.manifests import read_items
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
    wait: Wait = False,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Submit every scan of a folder or manifest. Run again, it goes on: no scan is sent or queued twice.

    A manifest has the columns path, label, priority and keep_days, one for each option by its name (preset, size ...),
    and options (a JSON object of them); paths are relative to it, or file:// and s3:// URLs that the server can read.
    """
    with command(as_json) as display, Client(url, api_key) as client:
        options = job_options(given)
        run = BatchRun(
            place=scans.absolute(),
            by_reference=by_reference,
            options=options,
            priority=priority,
            retention_seconds=retention(keep_days),
        )
        _submit(client, display, batch or _id_from(scans), run, wait, timeout)


@app.command()
def resume(
    batch: BatchName,
    wait: Wait = False,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Go on with a `batch submit` that was broken off on this computer."""
    with command(as_json) as display, Client(url, api_key) as client:
        _submit(client, display, batch, remembered(client.config.url, batch), wait, timeout)


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
            for row, thumbnail in report_rows(client, batch):
                advance()
                rows.append(row)
                if thumbnail is not None:
                    thumbnails[row["job"]] = thumbnail
        written = [str(path) for path in write_report(output or Path(f"{batch}.html"), view, rows, thumbnails)]
        display.data({"files": written}, "\n".join(written))


@app.command()
def cancel(batch: BatchName, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Cancel every job of a batch that has not ended."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.cancel_batch(batch)
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
    items = read_items(run.place, run.options, run.priority, run.by_reference, run.retention_seconds)
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
