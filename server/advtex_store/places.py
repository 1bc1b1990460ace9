"""Where blobs lie, by the URL of the settings."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

from advtex_store.blobs import Blobs, FolderBlobs
from advtex_store.s3 import S3Blobs


def open_blobs(url: str, spool_dir: Path) -> Blobs:
    """The storage behind `file:///folder` or `s3://bucket/prefix`."""
    parts = urlsplit(url)
    if parts.scheme == "file":
        return FolderBlobs(Path(unquote(parts.path)))
    if parts.scheme == "s3":
        return S3Blobs(parts.netloc, parts.path.strip("/"), spool_dir)
    raise ValueError(f"ADVTEX_BLOB_URL is {url!r}: it must start with file:// or s3://")
