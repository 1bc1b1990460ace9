"""Makes advtex_client/client.py of advtex_client/async_client.py: `python client/make_sync_client.py`."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import unasync

PACKAGE = Path(__file__).parent / "advtex_client"
SOURCE = PACKAGE / "async_client.py"
TARGET = PACKAGE / "client.py"

DOCSTRING = '''"""The client for programs that wait: `Client`.

This file is made of `async_client.py`: edit that one, then run `python client/make_sync_client.py`.
"""
'''
NAMES = {  # beside those that unasync knows
    "AsyncBaseTransport": "BaseTransport",
    "AsyncClient": "Client",
    "aclose": "close",
    "aiter_bytes": "iter_bytes",
    "aiter_lines": "iter_lines",
    "aread": "read",
}
WAITING = {  # what blocks is called in a thread there, and in place here
    r"(?m)^from anyio\.to_thread import run_sync\n": "",
    r"\brun_sync\(\s*([\w.]+)(?:,\s*|(?=\)))": r"\1(",
    r"\banyio\b": "time",
}


def sync_client() -> str:
    """The text of client.py that async_client.py gives as it is now."""
    with tempfile.TemporaryDirectory() as folder:
        unasync.unasync_files([str(SOURCE)], [unasync.Rule(str(PACKAGE), folder, NAMES)])
        text = (Path(folder) / SOURCE.name).read_text(encoding="utf-8")
    text = DOCSTRING + text.partition('"""\n')[2]
    for pattern, replacement in WAITING.items():
        text = re.sub(pattern, replacement, text)
    return _ruff("format", text=_ruff("check", "--fix", "--unsafe-fixes", "--select=I,UP028", text=text))


def _ruff(*command: str, text: str) -> str:
    arguments = [sys.executable, "-m", "ruff", *command, "--quiet", "--stdin-filename", str(TARGET), "-"]
    return subprocess.run(arguments, input=text, stdout=subprocess.PIPE, encoding="utf-8", check=True).stdout


if __name__ == "__main__":
    TARGET.write_text(sync_client(), encoding="utf-8")
