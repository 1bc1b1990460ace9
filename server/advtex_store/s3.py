"""Blobs in an S3 bucket (AWS, MinIO, …) through obstore. Credentials and endpoint come from the `AWS_*` variables."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError, PreconditionError
from obstore.store import S3Store

from advtex_store.blobs import BlobInfo, Blobs, check_key
from advtex_store.errors import BlobNotFound, StoreError

PART = 8 << 20  # bytes per part of a multipart upload and per read


class S3Blobs(Blobs):
    """Blobs as objects below `prefix` of one bucket. Uploads pass through the spool folder, so that a wrong checksum
    can be refused before anything is visible."""

    def __init__(self, bucket: str, prefix: str, spool_dir: Path) -> None:
        super().__init__(spool_dir)
        self.bucket = bucket
        self._store = S3Store(
            bucket, prefix=prefix or None, client_options={"allow_http": True}, retry_config={"max_retries": 4}
        )

    def put_if_absent(self, key: str, data: bytes) -> bool:
        try:
            obstore.put(self._store, check_key(key), data, mode="create")
        except (AlreadyExistsError, PreconditionError):
            return False
        return True

    def stream(self, key: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        size = self.head(key).size
        stop = size if end is None else min(end, size)
        return self._ranges(key, start, stop)

    def _ranges(self, key: str, start: int, stop: int) -> Iterator[bytes]:
        for offset in range(start, stop, PART):
            try:
                yield bytes(obstore.get_range(self._store, key, start=offset, end=min(offset + PART, stop)))
            except (NotFoundError, FileNotFoundError):
                raise BlobNotFound(key) from None

    def head(self, key: str) -> BlobInfo:
        try:
            meta = obstore.head(self._store, check_key(key))
        except (NotFoundError, FileNotFoundError):
            raise BlobNotFound(key) from None
        return BlobInfo(key, meta["size"], (meta["e_tag"] or "").strip('"'))

    def list(self, prefix: str) -> Iterator[BlobInfo]:
        if not prefix.endswith("/"):
            raise ValueError(f"a prefix ends in '/': {prefix!r}")
        check_key(prefix[:-1])
        found = [meta for page in obstore.list(self._store, prefix=prefix[:-1]) for meta in page]
        for meta in sorted(found, key=lambda m: m["path"]):
            yield BlobInfo(meta["path"], meta["size"], (meta["e_tag"] or "").strip('"'))

    def delete(self, key: str) -> None:
        try:
            obstore.delete(self._store, check_key(key))
        except (NotFoundError, FileNotFoundError):
            return

    def check(self) -> None:
        try:
            obstore.list_with_delimiter(self._store, prefix="jobs/none")
        except BaseError as error:
            raise StoreError(f"the bucket {self.bucket} cannot be reached: {error}") from error

    def _publish(self, path: Path, key: str) -> None:
        obstore.put(self._store, key, path, chunk_size=PART, max_concurrency=4)
