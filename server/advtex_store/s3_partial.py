"""Uploads that arrive in pieces, as multipart uploads of S3.

    {key}.multipart                 the id of the multipart upload; created once
    {key}.tail-{offset}-{holder}    what this holder made durable before this offset: the ETags of all full parts, as a
                                    line of JSON, and then the bytes of the part that is not full yet, because only the
                                    last part may be below 5 MiB

All parts but the last have the same size, so that an offset says which part comes next and how much of it its tail
holds.

S3 has no locks: a request that has lost the row may still replace a part, or write a tail. Its tail has its own name.
The row tells of one tail, whose ETags say what every part must be: the object is made of exactly those parts, or not at
all. Whoever goes on with an upload whose parts were replaced goes back to the first of them.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress

from advtex_store.bucket import PART, Bucket
from advtex_store.errors import BlobNotFound, BlobsUnavailable
from advtex_store.partials import Hold, Partial

MAX_PARTS = 9_000  # S3 allows 10,000
MULTIPART_SUFFIX = ".multipart"


class S3Partial(Partial):
    """Full parts are sent as they fill up; the rest waits in memory, and in a tail object once it is flushed."""

    def __init__(self, bucket: Bucket, key: str, size: int, offset: int, hold: Hold) -> None:
        super().__init__(offset)
        self._bucket = bucket
        self._key = key
        self._size = size
        self._hold = hold
        self._part = max(PART, math.ceil(size / MAX_PARTS))
        self._etags: list[str] = []
        self._buffer = bytearray()
        self._told: str | None = None  # name of the tail that the row tells of ...
        self._tail: str | None = None  # ... and of the newest one
        self._flushed = offset
        self._upload_id = self._begun()
        parts = bucket.parts(key, self._upload_id)
        if offset > 0:
            self._read_tail(parts)
        replaced = [number for number, etag in enumerate(self._etags) if parts.get(number + 1) != etag]
        if replaced:
            self.offset = replaced[0] * self._part
            del self._etags[replaced[0] :], self._buffer[:]

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
        if self.offset == self._flushed:
            return
        if self.offset == self._size and self._buffer:
            self._send()
        self._hold.check()
        self._tail = f"{self._key}.tail-{self.offset}-{self._hold.holder}"
        self._bucket.put(self._tail, json.dumps(self._etags).encode() + b"\n" + self._buffer)
        self._flushed = self.offset

    def settle(self) -> None:
        before, self._told = self._told, self._tail
        if before is not None and before != self._tail:
            self._bucket.delete(before)

    def publish(self) -> None:
        try:
            self._bucket.complete(self._key, self._upload_id, self._etags)
        except (BlobNotFound, BlobsUnavailable):  # another request may have been faster
            if not self._is_published():
                raise
        drop(self._bucket, self._key)

    def close(self) -> None:
        self._buffer.clear()

    def _send(self) -> None:
        self._hold.check()
        number = len(self._etags) + 1
        self._etags.append(self._bucket.put_part(self._key, self._upload_id, number, bytes(self._buffer)))
        self._buffer.clear()

    def _begun(self) -> str:
        """The id of the multipart upload, of a new one at the very beginning."""
        name = self._key + MULTIPART_SUFFIX
        with suppress(BlobNotFound):
            return self._bucket.get(name).decode()
        if self.offset > 0:
            raise BlobNotFound(name)
        upload_id = self._bucket.begin(self._key)
        if self._bucket.put_if_absent(name, upload_id.encode()):
            return upload_id
        self._bucket.abort(self._key, upload_id)
        return self._bucket.get(name).decode()

    def _read_tail(self, parts: dict[int, str]) -> None:
        self._told = self._tail = f"{self._key}.tail-{self.offset}-{self._hold.kept_by}"
        try:
            line, _, rest = self._bucket.get(self._told).partition(b"\n")
            self._etags = json.loads(line)
        except BlobNotFound:
            rest = self._read_nameless_tail(parts)
        self._buffer += rest
        if min(len(self._etags) * self._part + len(rest), self._size) != self.offset:
            raise BlobNotFound(f"{self._key}: the first {self.offset} bytes are not held any more")

    def _read_nameless_tail(self, parts: dict[int, str]) -> bytes:
        """A server of an earlier version made it: it has the bytes alone, and is left out where there are none."""
        self._told = self._tail = f"{self._key}.tail-{self.offset}"
        full, rest = divmod(self.offset, self._part)
        self._etags = [parts[number] for number in sorted(parts) if number <= full]
        return self._bucket.get(self._told) if rest else b""

    def _is_published(self) -> bool:
        with suppress(BlobNotFound):
            return self._bucket.head(self._key).size == self._size
        return False


def drop(bucket: Bucket, key: str) -> None:
    """Remove the pieces of an upload; no error if there are none."""
    marker = key + MULTIPART_SUFFIX
    with suppress(BlobNotFound):
        bucket.abort(key, bucket.get(marker).decode())
    for found in bucket.objects(key.rpartition("/")[0]):
        if found.name.startswith(f"{key}."):
            bucket.delete(found.name)
