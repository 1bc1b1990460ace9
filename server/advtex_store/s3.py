"""Blobs in an S3 bucket (AWS, MinIO, …) through obstore. Credentials and endpoint come from the `AWS_*` variables."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import obstore
from obstore.exceptions import (
    AlreadyExistsError,
    BaseError,
    NotFoundError,
    PermissionDeniedError,
    PreconditionError,
    UnauthenticatedError,
)
from obstore.store import S3Store

from advtex_store.blobs import BlobInfo, Blobs, check_key, check_prefix
from advtex_store.errors import BlobNotFound, BlobsRefused, BlobsUnavailable
from advtex_store.partials import Partial, PublishedPartial, Unpublished
from advtex_store.s3_partial import MULTIPART_SUFFIX, S3Multipart, S3Partial

PART = 8 << 20  # bytes per part of a multipart upload and per read


class S3Blobs(Blobs):
    """Blobs as objects below `prefix` of one bucket. Uploads pass through the spool folder, so that a wrong checksum
    can be refused before anything is visible."""

    def __init__(self, bucket: str, prefix: str, spool_dir: Path) -> None:
        super().__init__(spool_dir)
        self.bucket = bucket
        self._multipart = S3Multipart(bucket, f"{prefix}/" if prefix else "")
        self._store = _open(bucket, prefix)

    def put_if_absent(self, key: str, data: bytes) -> bool:
        try:
            with _translated(key):
                obstore.put(self._store, check_key(key), data, mode="create")
        except (AlreadyExistsError, PreconditionError):
            return False
        return True

    def get(self, key: str) -> bytes:
        """In one request: of a blob that is replaced meanwhile, either all or nothing is new."""
        with _translated(key):
            return bytes(obstore.get(self._store, check_key(key)).bytes())

    def stream(self, key: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        size = self.head(key).size
        return self._ranges(key, start, size if end is None else min(end, size))

    def _ranges(self, key: str, start: int, stop: int) -> Iterator[bytes]:
        for offset in range(start, stop, PART):
            with _translated(key):
                chunk = bytes(obstore.get_range(self._store, key, start=offset, end=min(offset + PART, stop)))
            yield chunk

    def head(self, key: str) -> BlobInfo:
        with _translated(key):
            meta = obstore.head(self._store, check_key(key))
        return _info(meta)

    def list(self, prefix: str) -> Iterator[BlobInfo]:
        with _translated(prefix):
            pages = obstore.list(self._store, prefix=check_prefix(prefix))
            found = [_info(meta) for page in pages for meta in page]
        yield from sorted(found, key=lambda info: info.key)

    def folders(self, prefix: str) -> Iterator[str]:
        with _translated(prefix):
            found = obstore.list_with_delimiter(self._store, prefix=check_prefix(prefix))
        yield from [path.rstrip("/").rpartition("/")[2] for path in found["common_prefixes"]]

    def delete(self, key: str) -> None:
        with suppress(BlobNotFound), _translated(key):
            obstore.delete(self._store, check_key(key))

    def resume(self, key: str, size: int, offset: int) -> Partial:
        if self.is_published(key, size):
            return PublishedPartial(offset)
        return S3Partial(self, self._multipart, key, size, offset)

    def drop_partial(self, key: str) -> None:
        with suppress(BlobNotFound):
            self._multipart.abort(key, self.get(key + MULTIPART_SUFFIX).decode())
        for info in self.list(key.rpartition("/")[0] + "/"):
            if info.key.startswith(f"{key}."):
                self.delete(info.key)

    def unpublished(self, prefix: str) -> Iterator[Unpublished]:
        check_prefix(prefix)
        for key, upload_id in self._multipart.begun(prefix):
            try:
                marked = self.get(key + MULTIPART_SUFFIX).decode()
            except BlobNotFound:
                marked = upload_id  # may be written this moment
            except ValueError:
                continue  # somebody else's name
            yield Unpublished(key, upload_id, superseded=marked != upload_id)

    def abort(self, found: Unpublished) -> None:
        with suppress(BlobNotFound):
            self._multipart.abort(found.key, found.upload_id)

    def check(self) -> None:
        with self._existing_bucket():
            obstore.list_with_delimiter(self._store, prefix="jobs/none")

    def _publish(self, path: Path, key: str) -> None:
        with self._existing_bucket():
            obstore.put(self._store, key, path, chunk_size=PART, max_concurrency=4)

    @contextmanager
    def _existing_bucket(self) -> Iterator[None]:
        try:
            with _translated(self.bucket):
                yield
        except BlobNotFound:
            raise BlobsRefused(f"there is no bucket {self.bucket!r}, or the keys do not open it") from None


class FoundObject(NamedTuple):
    """An object of any bucket; `modified`: when it was written, nanoseconds since 1970."""

    name: str
    size: int
    modified: int


class BucketReader:
    """Objects below a prefix of any bucket, by whatever names they have."""

    def __init__(self, bucket: str, prefix: str) -> None:
        self._store = _open(bucket, prefix)

    def find(self, name: str) -> list[FoundObject]:
        """The object itself, or else all below it as of a folder, by name; empty if there are none."""
        try:
            with _translated(name):
                return [_found(name, obstore.head(self._store, name))]
        except BlobNotFound:
            with _translated(name):
                pages = obstore.list(self._store, prefix=name)
                return sorted(_found(meta["path"], meta) for page in pages for meta in page)

    def read(self, name: str, start: int, end: int) -> bytes:
        """The bytes of an object from `start` up to, not including, `end`."""
        with _translated(name):
            return bytes(obstore.get_range(self._store, name, start=start, end=end))

    def stream(self, name: str) -> Iterator[bytes]:
        """The bytes of an object, in chunks."""
        with _translated(name):
            size = obstore.head(self._store, name)["size"]
        for offset in range(0, size, PART):
            with _translated(name):
                chunk = bytes(obstore.get_range(self._store, name, start=offset, end=min(offset + PART, size)))
            yield chunk


def _open(bucket: str, prefix: str) -> S3Store:
    return S3Store(bucket, prefix=prefix or None, client_options={"allow_http": True}, retry_config={"max_retries": 4})


def _found(name: str, meta: obstore.ObjectMeta) -> FoundObject:
    milliseconds = round(meta["last_modified"].timestamp() * 1000)  # S3 states no finer ones
    return FoundObject(name, meta["size"], milliseconds * 1_000_000)


def _info(meta: obstore.ObjectMeta) -> BlobInfo:
    return BlobInfo(meta["path"], meta["size"], (meta["e_tag"] or "").strip('"'))


@contextmanager
def _translated(key: str) -> Iterator[None]:
    try:
        yield
    except (NotFoundError, FileNotFoundError):
        raise BlobNotFound(key) from None
    except (AlreadyExistsError, PreconditionError):
        raise
    except (PermissionDeniedError, UnauthenticatedError) as error:
        raise BlobsRefused(f"the object storage refuses access to {key}: {error}") from error
    except BaseError as error:
        raise BlobsUnavailable(f"the object storage does not answer: {error}") from error
