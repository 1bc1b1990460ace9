"""Uploads that arrive in pieces, as multipart uploads of S3.

    {key}.multipart     the id of the multipart upload; created once
    {key}.tail-{offset} what the part that is not full yet holds of the bytes before this offset: only the last part may
                        be below 5 MiB, and its bytes must be durable too. A request that another one has taken over
                        from may still write one; it never replaces the one that the row tells of

All parts but the last have the same size, so that an offset says which part comes next and how much of it its tail
holds. boto3, because obstore cannot go on with a multipart upload that another process began.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

from advtex_store.errors import BlobNotFound, BlobsUnavailable
from advtex_store.partials import Partial

if TYPE_CHECKING:
    from advtex_store.s3 import S3Blobs

PART = 8 << 20
MAX_PARTS = 9_000  # S3 allows 10,000
MULTIPART_SUFFIX = ".multipart"


class S3Multipart:
    """The calls of S3 that obstore does not have. Endpoint and credentials are those of the `AWS_*` variables."""

    def __init__(self, bucket: str, prefix: str) -> None:
        self._bucket = bucket
        self._prefix = prefix

    @cached_property
    def _client(self) -> Any:
        import boto3
        from botocore.config import Config

        endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or None
        config = Config(
            s3={"addressing_style": "path"} if endpoint else {},
            retries={"mode": "standard", "max_attempts": 4},
            request_checksum_calculation="when_required",  # some S3-alikes do not know the others
        )
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
        return boto3.session.Session().client("s3", endpoint_url=endpoint, region_name=region, config=config)

    def create(self, key: str) -> str:
        """Begin a multipart upload. -> its id"""
        with _translated(key):
            return str(self._client.create_multipart_upload(**self._named(key))["UploadId"])

    def put_part(self, key: str, upload_id: str, number: int, data: bytes) -> None:
        """Parts are numbered from 1; sending one again replaces it."""
        with _translated(key):
            self._client.upload_part(**self._named(key), UploadId=upload_id, PartNumber=number, Body=data)

    def complete(self, key: str, upload_id: str, size: int) -> None:
        """Make the object of all parts."""
        with _translated(key):
            pages = self._client.get_paginator("list_parts").paginate(**self._named(key), UploadId=upload_id)
            parts = [part for page in pages for part in page.get("Parts", [])]
            if sum(part["Size"] for part in parts) != size:
                raise BlobsUnavailable(f"{key}: parts are missing in the object storage")
            chosen = [{"PartNumber": part["PartNumber"], "ETag": part["ETag"]} for part in parts]
            self._client.complete_multipart_upload(
                **self._named(key), UploadId=upload_id, MultipartUpload={"Parts": chosen}
            )

    def begun(self, prefix: str) -> list[tuple[str, str]]:
        """Key and id of every multipart upload below the prefix that was neither completed nor aborted."""
        with _translated(prefix):
            pages = self._client.get_paginator("list_multipart_uploads").paginate(
                Bucket=self._bucket, Prefix=self._prefix + prefix
            )
            found = [upload for page in pages for upload in page.get("Uploads", [])]
        return [(upload["Key"].removeprefix(self._prefix), upload["UploadId"]) for upload in found]

    def abort(self, key: str, upload_id: str) -> None:
        """Drop all parts. BlobNotFound if that was done before."""
        with _translated(key):
            self._client.abort_multipart_upload(**self._named(key), UploadId=upload_id)

    def _named(self, key: str) -> dict[str, str]:
        return {"Bucket": self._bucket, "Key": self._prefix + key}


class S3Partial(Partial):
    """Full parts are sent as they fill up; the rest waits in memory, and in a tail object once it is flushed."""

    def __init__(self, blobs: S3Blobs, multipart: S3Multipart, key: str, size: int, offset: int) -> None:
        super().__init__(offset)
        self._blobs = blobs
        self._multipart = multipart
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
            self._multipart.complete(self._key, self._upload_id, self._size)
        except (BlobNotFound, BlobsUnavailable):  # another request for the same bytes may have been faster
            if not self._blobs.is_published(self._key, self._size):
                raise
        self._blobs.drop_partial(self._key)

    def close(self) -> None:
        self._buffer.clear()

    def _send(self) -> None:
        self._multipart.put_part(self._key, self._upload_id, self._number + 1, bytes(self._buffer))
        self._number += 1
        self._buffer.clear()

    def _begun(self, offset: int) -> str:
        """The id of the multipart upload, of a new one at the very beginning."""
        name = self._key + MULTIPART_SUFFIX
        if offset == 0 and not self._blobs.exists(name):
            upload_id = self._multipart.create(self._key)
            if self._blobs.put_if_absent(name, upload_id.encode()):
                return upload_id
            self._multipart.abort(self._key, upload_id)
        return self._blobs.get(name).decode()

    def _tail(self, offset: int) -> str:
        return f"{self._key}.tail-{offset}"


@contextmanager
def _translated(key: str) -> Iterator[None]:
    from botocore.exceptions import BotoCoreError, ClientError

    try:
        yield
    except ClientError as error:
        if error.response.get("Error", {}).get("Code") in ("NoSuchUpload", "NoSuchKey", "404"):
            raise BlobNotFound(key) from None
        raise BlobsUnavailable(f"the object storage does not answer: {error}") from error
    except BotoCoreError as error:
        raise BlobsUnavailable(f"the object storage does not answer: {error}") from error
