"""Files that are either whole or absent, whatever stops the process, and JSON that every reader takes."""

from __future__ import annotations

import json
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_masking = threading.Lock()


def json_text(data: object, indent: int | None = None) -> str:
    """What JSON has no word for becomes text, but numbers that are not finite become null."""
    finite = json.loads(json.dumps(data, default=str), parse_constant=lambda _constant: None)
    return json.dumps(finite, allow_nan=False, indent=indent)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Write to a neighbour of `path` that takes its name when the block ends well and is removed when it does not."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files private; a result is as readable as any other new file.
        Path(name).chmod(0o666 & ~_umask())
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace the file `path` by `data` in one move that survives a power cut."""
    with atomic_file(path) as file:
        file.write(data)


def _umask() -> int:
    # The mask can only be read by setting it, which all threads see: two at once would leave the wrong one behind.
    with _masking:
        mask = os.umask(0o022)
        os.umask(mask)
    return mask
