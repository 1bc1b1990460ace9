"""What durable files need."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from advtex_store.errors import NoSpace


def fsync_dir(folder: Path) -> None:
    """Make the names in a folder durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def translated(error: OSError) -> Exception:
    """NoSpace for a disk that is full, the error itself otherwise."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return NoSpace(f"the disk is full ({error.strerror})")
    return error
