"""`advtex-client`: check a scan, submit it, follow the job, fetch the model.

Exit codes: 0 ok, 2 usage, 3 auth, 4 rejected scan, 5 job failed, 6 network, 7 timeout, 130 interrupted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from advtex_client import cli_batch
from advtex_client._calls import ensure_succeeded, only_results
from advtex_client._cli import (
    EXIT_CODES,
    ApiKey,
    AsJson,
    DeadlineOption,
    Folder,
    JobId,
    KeepOption,
    Only,
    PriorityOption,
    ScanPath,
    Seconds,
    Url,
    command,
    deadline_given,
    exit_code_of,
    job_options,
    retention,
)
from advtex_client._display import Display, finding_lines, job_lines, job_table
from advtex_client.client import Client
from advtex_client.deep import deep_lines, deep_report
from advtex_client.doctor import examine
from advtex_client.errors import ScanRejectedError
from advtex_contract.jobs import RETRYABLE, TERMINAL, JobState, JobView
from advtex_options.flags import LayoutFlag, option_flags, version_flag
from advtex_scan.check import check_scan

app = typer.Typer(
    help="Texture RGB-D scans on an advtex server.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(cli_batch.app, name="batch")


@app.callback()
def advtex_client(
    _version: Annotated[bool, version_flag("advtex-client")] = False,
) -> None:
    """What all commands have in common."""


@app.command()
def check(
    scan: ScanPath,
    deep: Annotated[
        bool, typer.Option("--deep", help="also measure whether depth, mesh, colors and poses agree; needs the engine")
    ] = False,
    layout: LayoutFlag = None,
    as_json: AsJson = False,
) -> None:
    """Check a scan on this computer: every problem, where it is, and what helps."""
    with command(as_json) as display:
        report = check_scan(scan, layout)
        found, text, hopeless = report.to_dict(), report.format_text(), False
        if deep and report.frames_usable:
            measured = deep_report(scan, layout)
            found["conventions"], text = measured, "\n".join([text, *deep_lines(measured)])
            hopeless = measured is not None and bool(measured["hopeless"])
        display.data(found, text)
        if hopeless or not report.ok:
            raise typer.Exit(EXIT_CODES[ScanRejectedError])


@app.command()
@option_flags
def submit(
    scan: ScanPath,
    given: dict[str, Any],
    label: Annotated[str, typer.Option(help="a name of your own for the job")] = "",
    batch: Annotated[str | None, typer.Option(help="a name of your own for jobs that belong together")] = None,
    priority: PriorityOption = 0,
    keep_days: KeepOption = None,
    deadline: DeadlineOption = None,
    new: Annotated[bool, typer.Option("--new", help="make another job even if this scan was submitted before")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="follow the job until it ends")] = False,
    output: Folder = None,
    only: Only = None,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Check a scan, send it and queue a job. Run again, it goes on with the same job. -o waits and fetches."""
    with command(as_json) as display:
        options = job_options(given)
        kept, due = retention(keep_days), deadline_given(deadline)
        with Client(url, api_key) as client:
            with display.bytes_bar("sending") as bar:
                job = client.submit(
                    scan,
                    options,
                    label=label,
                    batch=batch,
                    priority=priority,
                    retention_seconds=kept,
                    deadline=due,
                    new=new,
                    on_bytes=bar.upload,
                )
            if job.state is JobState.checking:
                job = _checked(client, display, job.id, timeout)
            elif job.state in TERMINAL:
                again = f"`advtex-client retry {job.id}` or " if job.state in RETRYABLE else ""
                display.note(f"this scan was submitted before: job {job.id} {job.state}; {again}--new does it again")
            for line in finding_lines(job.warnings):
                display.note(line)
            if not wait and output is None:
                display.data(job, job.id)
                return
            display.note(f"job {job.id}")
            _finish(client, display, job, output, timeout, only)


@app.command()
def status(job: JobId, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Show where a job stands."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.get_job(job)
        display.data(view, job_lines(view))


@app.command()
def watch(
    job: JobId,
    output: Folder = None,
    only: Only = None,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Follow a job until it ends; with --json, one line per change."""
    with command(as_json) as display, Client(url, api_key) as client:
        _finish(client, display, client.get_job(job), output, timeout, only, every_change=as_json)


@app.command("list")
def list_(
    state: Annotated[JobState | None, typer.Option(help="only jobs in this state")] = None,
    label: Annotated[str | None, typer.Option(help="only jobs with this label")] = None,
    batch: Annotated[str | None, typer.Option(help="only jobs of this batch")] = None,
    limit: Annotated[int, typer.Option(min=1, help="show at most this many")] = 50,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first."""
    with command(as_json) as display, Client(url, api_key) as client:
        found = client.list_jobs(state=state, label=label, batch=batch, page=min(limit, 100))
        jobs = [job for job, _ in zip(found, range(limit), strict=False)]
        display.data(jobs, job_table(jobs) if jobs else "no jobs")


@app.command()
def cancel(job: JobId, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Stop a job; a running one writes a checkpoint first, and `retry` goes on from it."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.cancel_job(job)
        display.data(view, f"{view.id} {view.state}")


@app.command()
def retry(job: JobId, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Queue a failed or canceled job again; it goes on from its newest checkpoint."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.retry_job(job)
        display.data(view, f"{view.id} {view.state}")


@app.command()
def download(
    job: JobId,
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder to fetch into")] = Path(),
    name: Annotated[list[str] | None, typer.Option(help="only this file; may be given several times")] = None,
    only: Only = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Fetch a job's results; run again, it goes on where it stopped."""
    with command(as_json) as display, Client(url, api_key) as client:
        view = client.get_job(job)
        names = [*(name or []), *(only_results(view, only) if only is not None else [])]
        paths = _download(client, display, view, output, list(dict.fromkeys(names)))
        display.data([str(path) for path in paths], _lines(paths))


@app.command()
def delete(job: JobId, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Delete a job and its results on the server."""
    with command(as_json) as display, Client(url, api_key) as client:
        client.delete_job(job)
        display.data({"id": job, "deleted": True}, f"{job} deleted")


@app.command()
def doctor(url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Say what works and what does not: configuration, server, key, and the folder that remembers submissions."""
    with command(as_json) as display, Client(url, api_key) as client:
        found = list(examine(client))
        codes = [exit_code_of(finding.error) for finding in found if finding.error is not None]
        checks = [{"name": finding.name, "ok": finding.ok, "message": finding.message} for finding in found]
        lines = [f"{'ok  ' if finding.ok else 'FAIL'} {finding.name}: {finding.message}" for finding in found]
        display.data({"ok": not codes, "checks": checks}, "\n".join(lines))
        if codes:
            raise typer.Exit(codes[0])


def main() -> None:
    app()


def _checked(client: Client, display: Display, job_id: str, timeout: float | None) -> JobView:
    """The job once the server has checked its scan; raises how it ended if that was its end."""
    with display.job_bar() as bar:
        for job in client.watch_job(job_id, timeout=timeout, on_trouble=bar.trouble):
            bar.show(job)
            if job.state is not JobState.checking:
                break
    return _ended_well(display, job) if job.state in TERMINAL else job


def _finish(
    client: Client,
    display: Display,
    job: JobView,
    output: Path | None,
    timeout: float | None,
    only: str | None,
    every_change: bool = False,
) -> None:
    """Follow `job` to its end, then fetch its results or print it."""
    last = job
    with display.job_bar() as bar:
        for view in client.watch_job(job.id, timeout=timeout, on_trouble=bar.trouble):
            bar.show(view)
            if every_change:
                display.data(view, "")
            last = view
    _ended_well(display, last, told=every_change)
    if output is not None:
        paths = _download(client, display, last, output, None if only is None else only_results(last, only))
        display.data({"job": last.model_dump(mode="json"), "files": [str(path) for path in paths]}, _lines(paths))
    elif not every_change:
        display.data(last, last.id)


def _ended_well(display: Display, job: JobView, told: bool = False) -> JobView:
    """The job if it succeeded; else how it ended is raised, and before that printed for programs, unless it was."""
    if job.state is not JobState.succeeded and display.as_json and not told:
        display.data(job, "")
    return ensure_succeeded(job)


def _download(client: Client, display: Display, job: JobView, output: Path, names: list[str] | None) -> list[Path]:
    with display.bytes_bar("fetching") as bar:
        return client.download_results(job, output, names=names, on_bytes=bar.download)


def _lines(paths: list[Path]) -> str:
    return "\n".join(str(path) for path in paths)


if __name__ == "__main__":
    main()
