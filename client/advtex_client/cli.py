"""`advtex-client`: check a scan, submit it, follow the job, fetch the model.

Exit codes: 0 ok, 2 usage, 3 auth, 4 rejected scan, 5 job failed, 6 network, 7 timeout, 130 interrupted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from advtex_client._calls import ensure_succeeded
from advtex_client._display import Display, finding_lines, job_lines, job_table
from advtex_client.client import Client
from advtex_client.errors import (
    AuthError,
    BusyError,
    ClientError,
    IntegrityError,
    JobFailedError,
    NetworkError,
    ScanRejectedError,
    ServerError,
    WaitTimeoutError,
)
from advtex_contract.jobs import TERMINAL, JobState, JobView
from advtex_contract.options import METHOD_HELP, PRESET_HELP, JobOptions, Method, Preset
from advtex_scan.check import check_scan

EXIT_CODES: dict[type[ClientError], int] = {
    AuthError: 3,
    ScanRejectedError: 4,
    JobFailedError: 5,
    NetworkError: 6,
    ServerError: 6,
    BusyError: 6,
    IntegrityError: 6,
    WaitTimeoutError: 7,
}
RETRYABLE = (JobState.failed, JobState.canceled)
USAGE = 2
INTERRUPTED = 130

app = typer.Typer(
    help="Texture RGB-D scans on an advtex server.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ScanPath = Annotated[Path, typer.Argument(exists=True, readable=True, help="a scan: a folder or a zip")]
JobId = Annotated[str, typer.Argument(help="the job's id, as `submit` prints it", metavar="JOB")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on stdout")]
Url = Annotated[str | None, typer.Option("--url", help="the server; else ADVTEX_URL or the configuration file")]
ApiKey = Annotated[str | None, typer.Option("--api-key", help="the key; better given as ADVTEX_API_KEY")]
Seconds = Annotated[float | None, typer.Option("--timeout", min=0, help="stop waiting after this many seconds")]
Folder = Annotated[Path | None, typer.Option("-o", "--output", help="fetch the results into this folder")]
METHODS = "; ".join(f"{method}: {text}" for method, text in METHOD_HELP.items())
PRESETS = "; ".join(f"{preset}: {text}" for preset, text in PRESET_HELP.items())


@contextmanager
def command(as_json: bool) -> Iterator[Display]:
    """Every command's frame: errors become one message and an exit code."""
    display = Display(as_json)
    try:
        yield display
    except ClientError as error:
        exit_code = next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), USAGE)
        display.failure(error, exit_code)
        raise typer.Exit(exit_code) from error
    except KeyboardInterrupt as error:
        display.note("interrupted; what was sent or started on the server stays there")
        raise typer.Exit(INTERRUPTED) from error


@app.command()
def check(scan: ScanPath, as_json: AsJson = False) -> None:
    """Check a scan on this computer: every problem, where it is, and what helps."""
    with command(as_json) as display:
        report = check_scan(scan)
        display.data(report.to_dict(), report.format_text())
        if not report.ok:
            raise typer.Exit(EXIT_CODES[ScanRejectedError])


@app.command()
def submit(
    scan: ScanPath,
    preset: Annotated[Preset, typer.Option(help=PRESETS)] = Preset.auto,
    method: Annotated[Method, typer.Option(help=METHODS)] = Method.adversarial,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="working size of the views, pixels")] = None,
    holdout: Annotated[int | None, typer.Option(help="leave out every Nth frame and score on it")] = None,
    steps: Annotated[int | None, typer.Option(help="overrides the preset's step count")] = None,
    seed: Annotated[int | None, typer.Option(help="of the random numbers")] = None,
    face_budget: Annotated[int | None, typer.Option(help="decimate the mesh to this many faces")] = None,
    max_texture_size: Annotated[int | None, typer.Option(help="cap on the texture's side, texels")] = None,
    label: Annotated[str, typer.Option(help="a name of your own for the job")] = "",
    new: Annotated[bool, typer.Option("--new", help="make another job even if this scan was submitted before")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="follow the job until it ends")] = False,
    output: Folder = None,
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Check a scan, send it and queue a job. Run again, it goes on with the same job. -o waits and fetches."""
    with command(as_json) as display:
        width, height = _parsed_size(size)
        options = _options(
            preset=preset,
            method=method,
            width=width,
            height=height,
            steps=steps,
            face_budget=face_budget,
            max_texture_size=max_texture_size,
            holdout=holdout,
            seed=seed,
        )
        with Client(url, api_key) as client:
            with display.bytes_bar("sending") as bar:
                job = client.submit(scan, options, label=label, new=new, on_bytes=bar.upload)
            for line in finding_lines(job.warnings):
                display.note(line)
            if job.state in TERMINAL:
                again = f"`advtex-client retry {job.id}` or " if job.state in RETRYABLE else ""
                display.note(f"this scan was submitted before: job {job.id} {job.state}; {again}--new does it again")
            if not wait and output is None:
                display.data(job, job.id)
                return
            display.note(f"job {job.id}")
            _finish(client, display, job, output, timeout)


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
    timeout: Seconds = None,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Follow a job until it ends; with --json, one line per change."""
    with command(as_json) as display, Client(url, api_key) as client:
        _finish(client, display, client.get_job(job), output, timeout, every_change=as_json)


@app.command("list")
def list_(
    state: Annotated[JobState | None, typer.Option(help="only jobs in this state")] = None,
    label: Annotated[str | None, typer.Option(help="only jobs with this label")] = None,
    limit: Annotated[int, typer.Option(min=1, help="show at most this many")] = 50,
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first."""
    with command(as_json) as display, Client(url, api_key) as client:
        found = client.list_jobs(state=state, label=label, page=min(limit, 100))
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
    url: Url = None,
    api_key: ApiKey = None,
    as_json: AsJson = False,
) -> None:
    """Fetch a job's results; run again, it goes on where it stopped."""
    with command(as_json) as display, Client(url, api_key) as client:
        paths = _download(client, display, client.get_job(job), output, name)
        display.data([str(path) for path in paths], _lines(paths))


@app.command()
def delete(job: JobId, url: Url = None, api_key: ApiKey = None, as_json: AsJson = False) -> None:
    """Delete a job and its results on the server."""
    with command(as_json) as display, Client(url, api_key) as client:
        client.delete_job(job)
        display.data({"id": job, "deleted": True}, f"{job} deleted")


def main() -> None:
    app()


def _finish(
    client: Client,
    display: Display,
    job: JobView,
    output: Path | None,
    timeout: float | None,
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
    if last.state is not JobState.succeeded and display.as_json and not every_change:
        display.data(last, "")  # how it ended, for programs
    ensure_succeeded(last)
    if output is not None:
        paths = _download(client, display, last, output, None)
        display.data({"job": last.model_dump(mode="json"), "files": [str(path) for path in paths]}, _lines(paths))
    elif not every_change:
        display.data(last, last.id)


def _download(client: Client, display: Display, job: JobView, output: Path, names: list[str] | None) -> list[Path]:
    with display.bytes_bar("fetching") as bar:
        return client.download_results(job, output, names=names, on_bytes=bar.download)


def _lines(paths: list[Path]) -> str:
    return "\n".join(str(path) for path in paths)


def _parsed_size(size: str | None) -> tuple[int | None, int | None]:
    if size is None:
        return None, None
    match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", size.strip().lower())
    if match is None:
        raise ClientError(f"--size {size!r} is no size; give it as WxH in pixels, for example 320x240")
    return int(match[1]), int(match[2])


def _options(**given: object) -> JobOptions:
    try:
        return JobOptions.model_validate({name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise ClientError(f"option {field}={first['input']!r} is out of bounds: {first['msg']}") from error


if __name__ == "__main__":
    main()
