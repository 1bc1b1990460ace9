"""What all commands share: options, exit codes, and how errors end them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from advtex_client._display import Display
from advtex_client.doctor import ServerNotReady
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
from advtex_client.manifests import deadline_of, retention_seconds
from advtex_contract.options import JobOptions, chosen_options

EXIT_CODES: dict[type[ClientError], int] = {
    AuthError: 3,
    ScanRejectedError: 4,
    JobFailedError: 5,
    NetworkError: 6,
    ServerError: 6,
    BusyError: 6,
    ServerNotReady: 6,
    IntegrityError: 6,
    WaitTimeoutError: 7,
}
USAGE = 2
INTERRUPTED = 130


ScanPath = Annotated[Path, typer.Argument(exists=True, readable=True, help="a scan: a folder, zip, .r3d or .sens")]
JobId = Annotated[str, typer.Argument(help="the job's id, as `submit` prints it", metavar="JOB")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON on stdout")]
Url = Annotated[str | None, typer.Option("--url", help="the server; else ADVTEX_URL or the configuration file")]
ApiKey = Annotated[str | None, typer.Option("--api-key", help="the key; better given as ADVTEX_API_KEY")]
Seconds = Annotated[float | None, typer.Option("--timeout", min=0, help="stop waiting after this many seconds")]
Only = Annotated[
    str | None,
    typer.Option(metavar="WORDS", help="fetch only these files: names, kinds or endings, for example usdz,mobile"),
]
Folder = Annotated[Path | None, typer.Option("-o", "--output", help="fetch the results into this folder")]
PriorityOption = Annotated[int, typer.Option("--priority", min=-100, max=100, help="larger runs earlier")]
KeepOption = Annotated[
    float | None, typer.Option("--keep-days", help="how long a job is kept after its end; else the server's usual time")
]

DeadlineOption = Annotated[
    str | None,
    typer.Option("--deadline", metavar="TIME", help="by when a job is to have ended, such as 2026-01-31T08:00"),
]


def exit_code_of(error: ClientError) -> int:
    return next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), USAGE)


@contextmanager
def command(as_json: bool) -> Iterator[Display]:
    """Frame a command: errors become one message and an exit code."""
    display = Display(as_json)
    try:
        yield display
    except ClientError as error:
        exit_code = exit_code_of(error)
        display.failure(error, exit_code)
        raise typer.Exit(exit_code) from error
    except KeyboardInterrupt as error:
        display.note("interrupted; what was sent or started on the server stays there")
        raise typer.Exit(INTERRUPTED) from error


def retention(keep_days: float | None) -> int | None:
    """Return `--keep-days` in seconds. Raises ClientError."""
    try:
        return None if keep_days is None else retention_seconds(keep_days)
    except ValueError as error:
        raise ClientError(f"--keep-days {keep_days}: {error}") from error


def deadline_given(text: str | None) -> datetime | None:
    """Return `--deadline` as a time. Raises ClientError."""
    try:
        return None if text is None else deadline_of(text)
    except (ValueError, OverflowError) as error:
        raise ClientError(f"--deadline {text}: {error}; give a time such as 2026-01-31T08:00") from error


def job_options(given: Mapping[str, object]) -> JobOptions:
    """Return the options, those that were not given at their defaults. Raises ClientError for one out of bounds."""
    try:
        return chosen_options(given)
    except ValueError as error:
        raise ClientError(str(error)) from error
