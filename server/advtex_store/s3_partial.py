"""Uploads that arrive in pieces, as multipart uploads of S3.

    {key}.multipart     the id of the multipart upload; created once
    {key}.tail-{offset} what the part that is not full yet holds of the bytes before this offset: only the last part may
                        be below 5 MiB, and its bytes must be durable too. A request that another one has taken over
                        from may still write one; it never replaces the one that the row tells of

All parts but the last have the same size, so that an offset says which part comes next and how much of it its tail
holds.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from advtex_store.bucket import PART
from advtex_store.errors import BlobNotFound, BlobsUnavailable
from advtex_store.partials import Partial

if TYPE_CHECKING:
    from advtex_store.s3 import S3Blobs

MAX_PARTS = 9_000  # S3 allows 10,000
MULTIPART_SUFFIX = ".multipart"


class S3Partial(Partial):
    """Full parts are sent as they fill up; the rest waits in memory, and in a tail object once it is flushed."""

    def __init__(self, blobs: S3Blobs, key: str, size: int, offset: int) -> None:
        super().__init__(offset)
        self._blobs = blobs
        self._bucket = blobs.bucket
        self._key = key
        self._size = size
        self._part = max(PART, math.ceil(size / MAX_PARTS))
        self._number, rest = divmod(offset, self._part)
        self._buffer = bytearray(blobs.get(self._tail(offset)) if rest else b"")
        if len(self._buffer) != rest:
            raise BlobNotFound(f"{key}: the first {offset} bytes are not held any more")
        self._flushed = self._settled = offset
        self._upload_id = self._begun(offset)

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            piece = view[: self._part - len(self._buffer)]
            self._buffer += piece
            self.offset += len(piece)
            view = view[len(piece) :]
            if len(self._buffer) == self._part:
                self._send()

    def flush(self) -> None:
        if self._buffer and self.offset > self._flushed:
            self._blobs.put(self._tail(self.offset), bytes(self._buffer))
        self._flushed = self.offset

    def settle(self) -> None:
        before, self._settled = self._settled, self._flushed
        if before < self._settled and before % self._part:
            self._blobs.delete(self._tail(before))

    def publish(self) -> None:
        try:
            if self._buffer:
                self._send()
            self._bucket.complete(
                self._key, self._upload_id, list(self._bucket.parts(self._key, self._upload_id).values())
            )
        except (BlobNotFound, BlobsUnavailable):  # another request for the same bytes may have been faster
            if not self._blobs.is_published(self._key, self._size):
                raise
        self._blobs.drop_partial(self._key)

    def close(self) -> None:
        self._buffer.clear()

    def _send(self) -> None:
        self._bucket.put_part(self._key, self._upload_id, self._number + 1, bytes(self._buffer))
        self._number += 1
        self._buffer.clear()

    def _begun(self, offset: int) -> str:
        """The id of the multipart upload, of a new one at the very beginning."""
        name = self._key + MULTIPART_SUFFIX
        if offset == 0 and not self._blobs.exists(name):
            upload_id = self._bucket.begin(self._key)
            if self._blobs.put_if_absent(name, upload_id.encode()):
                return upload_id
            self._bucket.abort(self._key, upload_id)
        return self._blobs.get(name).decode()

    def _tail(self, offset: int) -> str:
        return f"{self._key}.tail-{offset}"
