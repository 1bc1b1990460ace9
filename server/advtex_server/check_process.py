"""The process that checks one scan: `python -m advtex_server.check_process PARENT_PID`.

It reads a request, one line of JSON, from stdin: `layout`, and either `path` or what `advtex_scan.open_remote` takes,
`label` and `files`. It writes lines of JSON to stdout: `{"fetch": [file, start, end]}`, which its parent answers on
stdin with a length and so many bytes, and at its end `{"report": ...}`. It holds no password and no key.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from advtex_scan import CheckReport, ScanFormatError, check_scan, open_remote
from advtex_store.process_ends import die_with_parent

LENGTH = struct.Struct("<Q")


class TornLine(Exception):
    """The parent does not answer any more."""


def run(request: dict[str, Any], answers: IO[bytes], replies: IO[bytes]) -> CheckReport:
    """The report on what the request names."""
    if "path" in request:
        return check_scan(request["path"], request["layout"])

    def fetch(file: str, start: int, end: int) -> bytes:
        _tell(answers, {"fetch": [file, start, end]})
        (length,) = LENGTH.unpack(_exactly(replies, LENGTH.size))
        return _exactly(replies, length)

    try:
        with open_remote(request["label"], request["files"], fetch) as archive:
            return check_scan(archive, request["layout"])
    except ScanFormatError as error:
        return CheckReport(findings=error.findings)


def _tell(answers: IO[bytes], message: dict[str, Any]) -> None:
    answers.write(json.dumps(message).encode() + b"\n")
    answers.flush()


def _exactly(replies: IO[bytes], length: int) -> bytes:
    data = replies.read(length)
    if len(data) < length:
        raise TornLine
    return data


def _go_first() -> None:
    """Where memory runs out, this process is ended and not the server."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


def main() -> None:
    die_with_parent(int(sys.argv[1]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the whole group; the parent decides
    _go_first()
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)  # stray prints belong in the log
        report = run(json.loads(sys.stdin.buffer.readline()), answers, sys.stdin.buffer)
        _tell(answers, {"report": report.to_dict()})


if __name__ == "__main__":
    main()
