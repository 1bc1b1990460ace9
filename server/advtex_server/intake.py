"""Bytes of scans on their way in, without HTTP. Everything here blocks; routes call it in threads.

An upload's row says how many of its bytes are durable. Whoever sends bytes first seizes the row, so that the newest
request wins, in whichever server process it arrives; an older one fails at its next step. The last step is one of the
row too: once it tells of all bytes the upload is decided, and whoever comes next completes it, if it was not done.
"""

from __future__ import annotations

import functools
import hashlib
import threading
import time
from collections import OrderedDict
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import structlog

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import UploadView
from advtex_server.refusal import ApiError
from advtex_server.settings import ServerSettings
from advtex_store import keys
from advtex_store.accounts import Caller
from advtex_store.blobs import FolderBlobs
from advtex_store.errors import BlobNotFound, QuotaExceeded, RecordNotFound, StoreError, Superseded
from advtex_store.models import UploadRow
from advtex_store.partials import Hold, Partial
from advtex_store.store import Store
from advtex_store.tracing import OFF, Traces

if TYPE_CHECKING:
    from hashlib import _Hash

KEEP_BYTES = 8 << 20  # made durable at a time ...
KEEP_SECONDS = 5.0  # ... or after this long on a slow line
DIGESTS = 256  # running digests that are remembered between requests
CHECKSUM_MISMATCH = 460  # the status that tus gives it

log = structlog.get_logger("advtex.server")


@dataclass(frozen=True, slots=True)
class Checksum:
    """What the client says that the bytes of one request add up to."""

    algorithm: str
    digest: bytes


class Intake:
    """Uploads as requests see them."""

    def __init__(self, store: Store, settings: ServerSettings, traces: Traces = OFF) -> None:
        self.store = store
        self.settings = settings
        self.traces = traces
        self.digests = Digests()

    def create(
        self, caller: Caller, size: int, filename: str, sha256: str | None = None, tus_metadata: str = ""
    ) -> UploadRow:
        """A row for `size` bytes, with room for them: the quota of the key, and space on the disk."""
        if size > self.settings.max_upload_bytes:
            raise ApiError(ErrorCode.too_large, f"uploads may have {self.settings.max_upload_bytes} bytes at most")
        if size == 0:
            raise ApiError(ErrorCode.bad_request, "the upload is empty")
        try:
            return self.store.uploads.create(
                caller.owner,
                size,
                filename,
                announced_sha256=sha256,
                tus_metadata=tus_metadata,
                max_bytes=caller.max_bytes,
                admit=lambda expected: self._check_room(size, expected),
            )
        except QuotaExceeded as error:
            raise ApiError(ErrorCode.quota_exceeded, str(error), status=413) from error

    def resume(self, owner: str, upload_id: str, checksum: Checksum | None = None) -> Receiving:
        """Take over an unfinished upload. RecordNotFound, also when its bytes are gone: then it is forgotten."""
        row = self.store.uploads.seize(upload_id, owner)
        assert row.holder is not None
        hold = Hold(row.holder, row.kept_by, functools.partial(self.store.uploads.check_held, row.id, row.holder))
        try:
            partial = self.store.blobs.resume(keys.scan_key(row.id), row.size, row.offset, hold)
        except BlobNotFound as error:
            log.error("an upload has lost its bytes", upload=row.id, offset=row.offset)
            self.forget(row.id, row.holder)
            raise RecordNotFound(f"upload {row.id} has lost its bytes: begin a new one") from error
        return Receiving(self, row, partial, checksum)

    def offset(self, owner: str, upload_id: str) -> UploadRow:
        """The row, with an offset that no older request will move any more; all bytes only if it is complete."""
        if self.upload(owner, upload_id).sha256 is None:
            with suppress(Superseded):  # it was completed meanwhile, or a newer request asks
                row = self.store.uploads.seize(upload_id, owner)
                if row.offset == row.size:
                    with closing(self.resume(owner, upload_id)) as receiving:
                        receiving.end()
        return self.upload(owner, upload_id)

    def upload(self, owner: str, upload_id: str) -> UploadRow:
        """A row that takes bytes, or took them."""
        row = self.store.uploads.upload(upload_id, owner)
        if row.source is not None:
            raise ApiError(ErrorCode.conflict, f"upload {row.id} is held by reference: it takes no bytes")
        return row

    def view(self, owner: str, upload_id: str) -> UploadView:
        return upload_view(self.store.uploads.upload(upload_id, owner))

    def find(self, owner: str, sha256: str) -> list[UploadView]:
        return [upload_view(row) for row in self.store.uploads.find(owner, sha256)]

    def delete(self, owner: str, upload_id: str) -> None:
        self.store.uploads.delete(upload_id, owner)

    def forget(self, upload_id: str, holder: str | None) -> None:
        """Keep nothing of an upload that cannot be completed, unless another request has it by now."""
        try:
            if self.store.uploads.discard(upload_id, holder):
                self.store.blobs.drop_partial(keys.scan_key(upload_id))
                self.store.blobs.delete(keys.scan_key(upload_id))
        except Exception as error:  # the row, if it is still there, expires within a day, and its blob with it
            log.warning("upload not removed yet", upload=upload_id, error=str(error))

    def _check_room(self, size: int, expected: int) -> None:
        # Bytes for an object storage do not stay on this disk.
        promised = expected if isinstance(self.store.blobs, FolderBlobs) else 0
        if self.store.blobs.free_bytes() - promised - size < self.settings.disk_reserve_bytes:
            raise ApiError(ErrorCode.insufficient_storage, f"no room for {size} bytes on the server's disk")


class Receiving:
    """An upload that this request has seized, and its bytes as they come.

    With a checksum, nothing is kept before all of the request's bytes have come and it fits.
    """

    def __init__(self, intake: Intake, row: UploadRow, partial: Partial, checksum: Checksum | None) -> None:
        self.row = row
        self.kept = row.offset
        self.expires_at = row.expires_at
        self._intake = intake
        self._partial = partial
        self._digest = intake.digests.take(row.id, row.offset, row.kept_by)
        self._checksum = checksum
        self._sum = hashlib.new(checksum.algorithm, usedforsecurity=False) if checksum else None
        self._kept_at = time.monotonic()
        self._lock = threading.Lock()  # a canceled request may leave a write running in its thread
        self._closed = False
        if partial.offset != row.offset:
            self._follow()

    def write(self, chunk: bytes) -> None:
        """Append; ApiError `too_large` beyond the announced size, NoSpace on a full disk."""
        with self._lock:
            if self._partial.offset + len(chunk) > self.row.size:
                raise ApiError(ErrorCode.too_large, f"more bytes came than the announced {self.row.size}")
            self._partial.write(chunk)
            if self._digest is not None:
                self._digest.update(chunk)
            if self._sum is not None:
                self._sum.update(chunk)
                return
            due = time.monotonic() - self._kept_at > KEEP_SECONDS
            if due or self._partial.offset - self.kept >= KEEP_BYTES:
                self._keep_part()

    def end(self) -> UploadView:
        """The request's bytes have all come: keep them, and complete the upload if they were its last."""
        with self._lock:
            if self._sum is not None and self._checksum is not None and self._sum.digest() != self._checksum.digest:
                self._digest = None
                raise ApiError(
                    ErrorCode.checksum_mismatch,
                    f"the bytes do not fit their Upload-Checksum ({self._checksum.algorithm}); send them again",
                    status=CHECKSUM_MISMATCH,
                )
            if self._partial.offset == self.row.size:
                return self._complete()
            self._keep_part()
            return upload_view(self.row).model_copy(update={"offset": self.kept, "expires_at": _time(self.expires_at)})

    def abandon(self, rest: bytes = b"") -> None:
        """The request ends before its time: keep what came, unless a checksum of all of it was to be checked."""
        with suppress(StoreError, ApiError, OSError):
            if self._sum is None and not self._closed:
                self.write(rest)
                with self._lock:
                    self._keep_part()

    def close(self) -> None:
        """Let go of the upload; what was kept stays."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            if self._digest is not None and self._partial.offset == self.kept:
                self._intake.digests.put(self.row.id, self.kept, self.row.kept_by, self._digest)
            self._partial.close()

    def _keep_part(self) -> None:
        if self._partial.offset < self.row.size:  # the last bytes are kept at the end: that decides the upload
            self._keep()

    def _keep(self) -> None:
        assert self.row.holder is not None
        if self.kept != (offset := self._partial.offset):
            self._partial.flush()
            self.expires_at = self._intake.store.uploads.advance(self.row.id, self.row.holder, offset)
            self.kept, self._kept_at = offset, time.monotonic()
            self.row.kept_by = self.row.holder
            self._partial.settle()

    def _follow(self) -> None:
        """The storage has all bytes although the row does not say so, or not all that the row tells of."""
        log.warning("upload put right", upload=self.row.id, offset=self.row.offset, held=self._partial.offset)
        try:
            self._digest = None
            self._keep()
            self.row.offset = self.kept
        except BaseException:
            self._partial.close()
            raise

    def _complete(self) -> UploadView:
        blobs, key = self._intake.store.blobs, keys.scan_key(self.row.id)
        self._keep()
        self._partial.publish()
        if self._digest is None:  # an earlier server process took the first bytes
            self._digest = hashlib.sha256()
            for chunk in blobs.stream(key):
                self._digest.update(chunk)
        sha256, announced = self._digest.hexdigest(), self.row.announced_sha256
        if announced is not None and sha256 != announced:
            self._intake.forget(self.row.id, self.row.holder)
            raise ApiError(
                ErrorCode.checksum_mismatch,
                f"the bytes have sha256 {sha256}, announced was {announced}; send them again",
            )
        facts = {"upload": self.row.id, "owner": self.row.owner, "bytes": self.row.size}
        span = self._intake.traces.span("upload", None, start=self.row.created_at, **facts)
        row = self._intake.store.uploads.finish(self.row.id, sha256, self.row.kept_by, span.traceparent)
        span.end()
        self._digest = None
        log.info("upload complete", upload=row.id, bytes=row.size, sha256=sha256)
        return upload_view(row)


class Digests:
    """Running digests of unfinished uploads, so that completing one need not read it all again."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[str, tuple[int, str | None, _Hash]] = OrderedDict()

    def put(self, upload_id: str, offset: int, kept_by: str | None, digest: _Hash) -> None:
        """Remember the digest of the first `offset` bytes as that request has kept them."""
        with self._lock:
            self._known[upload_id] = offset, kept_by, digest
            self._known.move_to_end(upload_id)
            if len(self._known) > DIGESTS:
                self._known.popitem(last=False)

    def take(self, upload_id: str, offset: int, kept_by: str | None) -> _Hash | None:
        """The digest of the first `offset` bytes as that request has kept them, None if it is not known."""
        if offset == 0:
            return hashlib.sha256()
        with self._lock:
            *known, digest = self._known.pop(upload_id, (0, None, None))
        return digest if known == [offset, kept_by] else None


def upload_view(row: UploadRow) -> UploadView:
    """The row as the API shows it."""
    return UploadView(
        id=row.id,
        size=row.size,
        offset=row.offset,
        complete=row.sha256 is not None,
        sha256=row.sha256,
        filename=row.filename,
        created_at=_time(row.created_at),
        expires_at=None if row.expires_at is None else _time(row.expires_at),
    )


def _time(seconds: float | None) -> datetime:
    return datetime.fromtimestamp(seconds or 0.0, UTC)
