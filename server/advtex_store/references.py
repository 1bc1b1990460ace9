"""Scans that stay where they are: `file://` and `s3://` URLs below the roots that the operator allowed.

Server and workers must see the same things there. Nothing outside of the roots is ever looked at: a path is resolved
first, symbolic links included, and only then compared; keys of object storage have no links, and no `..` either.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from advtex_scan import ArchiveLimits, unsafe_reason
from advtex_store.errors import BlobNotFound, BlobsRefused, ReferenceRefused, ReferenceUnreadable
from advtex_store.files import translated

if TYPE_CHECKING:
    from advtex_store.bucket import Bucket, FoundObject

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")


@dataclass(frozen=True, slots=True)
class _Place:
    """A URL, taken apart. `parts`: of the path or key, without empty ones, `.` and `..`."""

    scheme: str
    bucket: str
    parts: tuple[str, ...]

    @property
    def path(self) -> Path:
        return Path("/", *self.parts)

    def below(self, root: _Place) -> bool:
        same = (self.scheme, self.bucket) == (root.scheme, root.bucket)
        return same and self.parts[: len(root.parts)] == root.parts


@dataclass(frozen=True, slots=True)
class RemoteScan:
    """A scan in object storage. `files` and `fetch`: as `advtex_scan.open_remote` takes them."""

    label: str
    files: int | Mapping[str, int]
    fetch: Callable[[str, int, int], bytes]


class References:
    """`roots`: URLs of folders, or of buckets and prefixes."""

    def __init__(self, roots: Sequence[str]) -> None:
        self.roots = tuple(roots)
        self._roots = tuple(_resolved(_parse(root)) for root in roots)

    def look(self, url: str) -> Path | RemoteScan:
        """The scan where it is, of which nothing is read yet. Raises as `fetch` does."""
        place = self._allowed(url)
        if place.scheme == "file":
            _check_readable(place.path, url)
            return place.path
        try:
            bucket, name, found = _found(place, url)
        except BlobsRefused as error:
            raise _unreadable(url, error) from error
        alone = found[0].size if found[0].name == name else None
        inside = {key.removeprefix(f"{name}/"): size for key, size, *_ in found}

        def read(file: str, start: int, end: int) -> bytes:
            return bucket.get(f"{name}/{file}" if file else name, start, end)

        return RemoteScan(name, inside if alone is None else alone, read)

    def fetch(self, url: str, folder: Path, check: Callable[[], None] = lambda: None) -> Path:
        """The scan on this machine: in place for `file://`, else copied below `folder`, with the objects' times.

        ReferenceRefused for what is not allowed or no URL, ReferenceUnreadable for what this service has no right to
        read; BlobNotFound if there is nothing. check: called between pieces, may raise to end it.
        """
        place = self._allowed(url)
        if place.scheme == "file":
            _check_readable(place.path, url)
            return place.path
        try:
            return _copy(place, url, folder, check)
        except BlobsRefused as error:
            raise _unreadable(url, error) from error

    def _allowed(self, url: str) -> _Place:
        place = _parse(url)
        # Compared before and after links are followed, so that nothing can be learned about what lies outside.
        if any(place.below(root) for root in (*self._roots, *map(_parse, self.roots))):
            resolved = _resolved(place)
            if any(resolved.below(root) for root in self._roots):
                return resolved
        allowed = f"allowed is what lies below {', '.join(self.roots)}" if self.roots else "the operator allowed none"
        raise ReferenceRefused(f"{url} is not a place that scans may be read from: {allowed}")


def _parse(url: str) -> _Place:
    try:
        parts = urlsplit(url)
        host = parts.netloc
    except ValueError:
        raise ReferenceRefused(f"{url!r} is no URL") from None
    if parts.query or parts.fragment or "?" in url or "#" in url:
        raise ReferenceRefused(f"{url}: '?' and '#' are not part of a scan's URL; write them as %3F and %23")
    if parts.scheme not in ("file", "s3"):
        raise ReferenceRefused(f"{url}: a scan is referred to by file:///folder or s3://bucket/prefix")
    if parts.scheme == "file" and host not in ("", "localhost"):
        raise ReferenceRefused(f"{url}: file:// URLs have three slashes and no host")
    if parts.scheme == "s3" and not _BUCKET.fullmatch(host):
        raise ReferenceRefused(f"{url}: {host!r} is no name of a bucket")
    name = unquote(parts.path, errors="surrogateescape").strip("/")
    if name and (reason := unsafe_reason(name)) is not None:
        raise ReferenceRefused(f"{url}: {reason}")
    return _Place(parts.scheme, host if parts.scheme == "s3" else "", tuple(name.split("/")) if name else ())


def _resolved(place: _Place) -> _Place:
    if place.scheme != "file":
        return place
    try:
        path = place.path.resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise ReferenceRefused(f"{place.path.as_uri()} cannot be resolved") from None
    return _Place("file", "", path.parts[1:])


def _check_readable(path: Path, url: str) -> None:
    """Whether a folder can be listed and entered, or a file opened. BlobNotFound, ReferenceUnreadable."""
    try:
        if path.is_dir():
            next(path.iterdir(), path).stat()
        else:
            path.open("rb").close()
    except (FileNotFoundError, NotADirectoryError):
        raise BlobNotFound(f"there is nothing at {url}") from None
    except PermissionError as error:
        remedy = "let its user read it and enter the folders above it"
        raise ReferenceUnreadable(f"{url} cannot be read by the service ({error.strerror}): {remedy}") from None


def _unreadable(url: str, error: BlobsRefused) -> ReferenceUnreadable:
    return ReferenceUnreadable(f"{url} cannot be read by the service: {error}")


def _found(place: _Place, url: str) -> tuple[Bucket, str, list[FoundObject]]:
    """The bucket's part that holds the scan, the scan's name there, and its objects."""
    from advtex_store.bucket import Bucket

    if not place.parts:
        raise ReferenceRefused(f"{url} is a whole bucket: name a scan in it")
    *parents, name = place.parts
    bucket = Bucket(place.bucket, "/".join(parents))
    found = _objects(bucket, name)
    limits = ArchiveLimits()
    if not found:
        raise BlobNotFound(f"there is nothing at {url}")
    total = sum(item.size for item in found)
    if len(found) > limits.entries or total > limits.total_bytes:
        raise ReferenceRefused(f"{url} is no scan: it holds {len(found)} objects, {total} bytes")
    for item in found:
        if (reason := unsafe_reason(item.name)) is not None:
            raise ReferenceRefused(f"{url} holds {item.name!r}: {reason}")
    return bucket, name, found


def _objects(bucket: Bucket, name: str) -> list[FoundObject]:
    """The object itself, or else all below it as of a folder; empty if there are none."""
    try:
        return [bucket.head(name)]
    except BlobNotFound:
        return bucket.objects(name)


def _copy(place: _Place, url: str, folder: Path, check: Callable[[], None]) -> Path:
    bucket, name, found = _found(place, url)
    for key, size, _, modified in found:
        try:
            _download(bucket, key, size, folder / key, check)
            os.utime(folder / key, ns=(modified, modified))
        except OSError as error:
            raise translated(error) from error
    return folder / name


def _download(bucket: Bucket, key: str, size: int, target: Path, check: Callable[[], None]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("wb") as file:
        for chunk in bucket.stream(key, 0, size):
            file.write(chunk)
            check()
