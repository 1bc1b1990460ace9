"""Blobs in a bucket of S3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from advtex_store.blobs import BlobInfo, Blobs, check_key, check_prefix
from advtex_store.bucket import Bucket, FoundObject
from advtex_store.errors import BlobNotFound
from advtex_store.partials import Hold, Partial, Unpublished
from advtex_store.s3_partial import MULTIPART_SUFFIX, S3Partial, drop


class S3Blobs(Blobs):
    """Blobs as objects below `prefix` of one bucket. What comes in one go passes through the spool folder, so that a
    wrong checksum can be refused before anything is visible."""

    def __init__(self, bucket: str, prefix: str, spool_dir: Path) -> None:
        super().__init__(spool_dir)
        self.bucket = Bucket(bucket, prefix)

    def put_if_absent(self, key: str, data: bytes) -> bool:
        return self.bucket.put_if_absent(check_key(key), data)

    def get(self, key: str) -> bytes:
        """In one request: of a blob that is replaced meanwhile, either all or nothing is new."""
        return self.bucket.get(check_key(key))

    def stream(self, key: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        size = self.head(key).size
        return self.bucket.stream(key, start, size if end is None else min(end, size))

    def head(self, key: str) -> BlobInfo:
        return _info(self.bucket.head(check_key(key)))

    def list(self, prefix: str) -> Iterator[BlobInfo]:
        yield from map(_info, self.bucket.objects(check_prefix(prefix)))

    def folders(self, prefix: str) -> Iterator[str]:
        return self.bucket.folders(check_prefix(prefix))

    def delete(self, key: str) -> None:
        self.bucket.delete(check_key(key))

    def drop_partial(self, key: str) -> None:
        drop(self.bucket, check_key(key))

    def unpublished(self, prefix: str) -> Iterator[Unpublished]:
        for key, upload_id in self.bucket.begun(check_prefix(prefix)):
            try:
                marked = self.get(key + MULTIPART_SUFFIX).decode()
            except BlobNotFound:
                marked = upload_id  # may be written this moment
            except ValueError:
                continue  # somebody else's name
            yield Unpublished(key, upload_id, superseded=marked != upload_id)

    def abort(self, found: Unpublished) -> None:
        self.bucket.abort(found.key, found.upload_id)

    def check(self) -> None:
        for _ in self.bucket.folders("jobs/none"):
            return

    def _resume(self, key: str, size: int, offset: int, hold: Hold) -> Partial:
        return S3Partial(self.bucket, key, size, offset, hold)

    def _publish(self, path: Path, key: str) -> None:
        self.bucket.put_file(key, path)


def _info(found: FoundObject) -> BlobInfo:
    return BlobInfo(found.name, found.size, found.etag)
