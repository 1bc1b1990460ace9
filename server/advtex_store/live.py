"""What a running job's texture looks like now: one small blob per attempt, replaced every few seconds.

It is no part of the result and nothing depends on it. It goes with the job, and before that once the job has results.
"""

from __future__ import annotations

from pydantic import ValidationError

from advtex_contract.live import LiveRecord
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.errors import BlobNotFound


class Live:
    """Written by the attempt that holds the job, read by whoever watches it."""

    def __init__(self, blobs: Blobs) -> None:
        self.blobs = blobs

    def write(self, job_id: str, attempt: int, record: LiveRecord) -> None:
        """Replace what the attempt has shown so far. An attempt writes under its own number, so that one that lost its
        job without noticing shows nothing as soon as the next one has something to show."""
        self.blobs.put(keys.live_key(job_id, attempt), record.model_dump_json().encode())

    def read(self, job_id: str, attempt: int) -> LiveRecord | None:
        """The newest look, of this attempt or, until it has one, of the one before. attempt: 0 before the first."""
        for number in range(attempt, max(attempt - 2, 0), -1):
            try:
                return LiveRecord.model_validate_json(self.blobs.get(keys.live_key(job_id, number)))
            except (BlobNotFound, ValidationError):  # another version of the worker wrote it
                continue
        return None

    def drop_earlier(self, job_id: str, attempt: int) -> None:
        """Remove the looks of attempts before this one."""
        for number in range(1, attempt):
            self.blobs.delete(keys.live_key(job_id, number))
