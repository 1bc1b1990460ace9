"""One bucket of an S3 (AWS, MinIO, …) through boto3, with this package's own errors.

boto3 alone: obstore, and other wrappers of Rust's object_store, are as fast (1 GB to and from one server took the same
time and processor time, to 10 %) and import sooner, but cannot go on with a multipart upload that another process
began: they have no upload ids, part numbers or ETags, and no list of the uploads that were begun.
Credentials and endpoint come from the `AWS_*` variables, or wherever else boto3 finds them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import boto3.session
from boto3.exceptions import S3UploadFailedError
from boto3.s3.transfer import TransferConfig
from botocore.config import Config
from botocore.exceptions import (
    BotoCoreError,
    ClientError,
    IncompleteReadError,
    ReadTimeoutError,
    ResponseStreamingError,
)

from advtex_store.errors import BlobNotFound, BlobsRefused, BlobsUnavailable

PART = 8 << 20  # bytes per part of a large object, and per read
ATTEMPTS = 4
CONNECTIONS = 50  # as many as a server has threads, and some
CONFLICT_SECONDS = 0.2
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class FoundObject(NamedTuple):
    """An object of a bucket; `modified`: when it was written, nanoseconds since 1970."""

    name: str
    size: int
    etag: str
    modified: int


class Bucket:
    """Objects below a prefix, by their names behind it.

    Raises BlobNotFound, BlobsUnavailable, and BlobsRefused where no retry helps. Threads may share it.
    """

    def __init__(self, name: str, prefix: str) -> None:
        self.name = name
        self._prefix = f"{prefix}/" if prefix else ""

    @cached_property
    def _client(self) -> Any:
        endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or None
        config = Config(
            s3={"addressing_style": "path"} if endpoint else {},
            retries={"mode": "standard", "max_attempts": ATTEMPTS},
            connect_timeout=5,
            max_pool_connections=CONNECTIONS,
            request_checksum_calculation="when_required",  # some S3-alikes do not know the others
            response_checksum_validation="when_required",
        )
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
        return boto3.session.Session().client("s3", endpoint_url=endpoint, region_name=region, config=config)

    # -- objects --------------------------------------------------------------------------------------------------

    def put(self, name: str, data: bytes) -> None:
        """Store a small object, replacing what was there."""
        with self._translated(name):
            self._client.put_object(**self._named(name), Body=data)

    def put_if_absent(self, name: str, data: bytes) -> bool:
        """Store a small object unless the name is taken; atomic among all writers. -> whether this call stored it"""
        for _ in range(ATTEMPTS):
            try:
                with self._translated(name):
                    self._client.put_object(**self._named(name), Body=data, IfNoneMatch="*")
                return True
            except _Taken:
                return False
            except _Conflict:  # with another one that has not ended, and may fail
                time.sleep(CONFLICT_SECONDS)
        raise BlobsUnavailable(f"the object storage is busy with {name}")

    def put_file(self, name: str, path: Path) -> None:
        """Store a local file of any size; a large one in parts, several at a time."""
        transfer = TransferConfig(multipart_threshold=PART, multipart_chunksize=PART, max_concurrency=4)
        with self._translated(name):
            self._client.upload_file(os.fspath(path), **self._named(name), Config=transfer)

    def get(self, name: str, start: int = 0, stop: int | None = None) -> bytes:
        """Bytes `start` up to, not including, `stop`, in one request; of an empty object only all."""
        span = {} if (start, stop) == (0, None) else {"Range": f"bytes={start}-{'' if stop is None else stop - 1}"}
        for attempt in range(ATTEMPTS):
            try:
                with self._translated(name):
                    body = self._client.get_object(**self._named(name), **span)["Body"]
                    return bytes(body.read())
            except _Broken:
                if attempt == ATTEMPTS - 1:
                    raise
        raise AssertionError

    def stream(self, name: str, start: int, stop: int) -> Iterator[bytes]:
        """The same in pieces."""
        for offset in range(start, stop, PART):
            yield self.get(name, offset, min(offset + PART, stop))

    def head(self, name: str) -> FoundObject:
        """Name, size, etag and time of an object."""
        with self._translated(name):
            answer = self._client.head_object(**self._named(name))
        return _found(name, answer["ContentLength"], answer)

    def objects(self, folder: str) -> list[FoundObject]:
        """All objects below `folder`, by name, without the empty ones that stand for folders in some tools."""
        pages = self._pages("list_objects_v2", f"{folder}/")
        items = [item for page in pages for item in page.get("Contents", []) if not item["Key"].endswith("/")]
        return sorted(_found(item["Key"].removeprefix(self._prefix), item["Size"], item) for item in items)

    def folders(self, folder: str) -> Iterator[str]:
        """The next path segments below `folder`, of whatever lies deeper."""
        for page in self._pages("list_objects_v2", f"{folder}/", Delimiter="/"):
            for item in page.get("CommonPrefixes", []):
                yield item["Prefix"].rstrip("/").rpartition("/")[2]

    def delete(self, name: str) -> None:
        """Remove an object; no error if there is none."""
        with self._translated(name):
            self._client.delete_object(**self._named(name))

    # -- multipart uploads ----------------------------------------------------------------------------------------

    def begin(self, name: str) -> str:
        """Begin a multipart upload. -> its id"""
        with self._translated(name):
            return str(self._client.create_multipart_upload(**self._named(name))["UploadId"])

    def put_part(self, name: str, upload_id: str, number: int, data: bytes) -> str:
        """Store a part, in place of the one of the same number; they begin with 1. -> its ETag"""
        with self._translated(name):
            answer = self._client.upload_part(**self._named(name), UploadId=upload_id, PartNumber=number, Body=data)
        return str(answer["ETag"])

    def parts(self, name: str, upload_id: str) -> dict[int, str]:
        """The ETags of all parts by their numbers."""
        with self._translated(name):
            pages = self._client.get_paginator("list_parts").paginate(**self._named(name), UploadId=upload_id)
            return {part["PartNumber"]: part["ETag"] for page in pages for part in page.get("Parts", [])}

    def complete(self, name: str, upload_id: str, etags: list[str]) -> None:
        """Make the object of parts 1, 2, …; refused if one of them is not, or no more, what its ETag says."""
        parts = [{"PartNumber": number, "ETag": etag} for number, etag in enumerate(etags, 1)]
        with self._translated(name):
            self._client.complete_multipart_upload(
                **self._named(name), UploadId=upload_id, MultipartUpload={"Parts": parts}
            )

    def begun(self, folder: str) -> Iterator[tuple[str, str]]:
        """Name and id of every multipart upload below `folder` that was neither completed nor aborted."""
        for page in self._pages("list_multipart_uploads", f"{folder}/"):
            for upload in page.get("Uploads", []):
                yield upload["Key"].removeprefix(self._prefix), upload["UploadId"]

    def abort(self, name: str, upload_id: str) -> None:
        """Drop all parts; no error if there are none any more."""
        with suppress(BlobNotFound), self._translated(name):
            self._client.abort_multipart_upload(**self._named(name), UploadId=upload_id)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _named(self, name: str) -> dict[str, str]:
        return {"Bucket": self.name, "Key": self._prefix + name}

    def _pages(self, operation: str, prefix: str, **options: str) -> list[Any]:
        with self._translated(prefix):
            pages = self._client.get_paginator(operation).paginate(
                Bucket=self.name, Prefix=self._prefix + prefix, **options
            )
            return list(pages)

    @contextmanager
    def _translated(self, name: str) -> Iterator[None]:
        try:
            yield
        except (ClientError, S3UploadFailedError) as error:
            answer = error if isinstance(error, ClientError) else error.__context__
            raise self._refusal(name, answer) from error
        except (IncompleteReadError, ReadTimeoutError, ResponseStreamingError) as error:
            raise _Broken(f"the object storage broke off: {error}") from error
        except BotoCoreError as error:
            raise BlobsUnavailable(f"the object storage does not answer: {error}") from error

    def _refusal(self, name: str, answer: BaseException | None) -> Exception:
        if not isinstance(answer, ClientError):
            return BlobsUnavailable(f"the object storage does not answer: {answer}")
        code = answer.response.get("Error", {}).get("Code")
        status = answer.response.get("ResponseMetadata", {}).get("HTTPStatusCode")
        if code == "NoSuchBucket":
            return BlobsRefused(f"there is no bucket {self.name!r}")
        if status == 404:
            return BlobNotFound(name)
        if status in (401, 403):
            return BlobsRefused(f"the object storage refuses access to {name}: {answer}")
        if status == 412:
            return _Taken(name)
        if status == 409:
            return _Conflict(f"the object storage is busy with {name}: {answer}")
        return BlobsUnavailable(f"the object storage does not answer: {answer}")


class _Taken(BlobsUnavailable):
    """There is an object of this name."""


class _Conflict(BlobsUnavailable):
    """Another write of the same name goes on."""


class _Broken(BlobsUnavailable):
    """The answer ended before its time, which boto3 leaves to its caller."""


def _found(name: str, size: int, answer: Any) -> FoundObject:
    milliseconds = round((answer["LastModified"] - _EPOCH).total_seconds() * 1000)  # S3 states no finer ones
    return FoundObject(name, size, answer["ETag"].strip('"'), milliseconds * 1_000_000)
