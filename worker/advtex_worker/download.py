"""A scan that was uploaded, from the storage to this machine: its bytes, and no others.

A storage that answers with other bytes than it was given would make a sound scan look like one that its user has
damaged, or a texture of what nobody photographed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import IO

import structlog

from advtex_store import keys
from advtex_store.errors import ScanDamaged
from advtex_store.store import Store

TRIES = 2  # what went wrong on the way goes right the next time

log = structlog.get_logger()


def download_scan(store: Store, upload_id: str, file: IO[bytes], arrived: Callable[[int], None]) -> None:
    """Writes the scan to an empty file. arrived: told of each piece's bytes, so that it may count or end it.

    Raises ScanDamaged where the storage holds other bytes than those that were uploaded.
    """
    wanted = store.uploads.digest(upload_id)
    for _ in range(TRIES):
        file.seek(0)
        file.truncate()
        digest = hashlib.sha256()
        for chunk in store.blobs.stream(keys.scan_key(upload_id)):
            file.write(chunk)
            digest.update(chunk)
            arrived(len(chunk))
        if wanted in (None, digest.hexdigest()):
            return
        log.warning("the scan came with other bytes than it was uploaded with", upload=upload_id)
    raise ScanDamaged("the storage no longer holds the bytes of the scan that were uploaded; submit it again")
