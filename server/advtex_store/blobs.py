"""Scans, checkpoints and results: a local folder, or a bucket of S3.

Nothing is ever half there: a blob is written aside, made durable (fsync of file and folders, or a completed multipart
upload) and only then gets its name. Bytes pass in chunks; no blob is ever whole in memory except through `get`.
Names are in `keys.py`. All calls block; the server makes them in threads.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from advtex_store.errors import BlobNotFound, BlobsUnavailable
from advtex_store.files import fsync_dir, translated
from advtex_store.partials import FolderPartial, Hold, Partial, PublishedPartial, Unpublished

CHUNK = 1 << 20
PLACE_ATTEMPTS = 100
PARTIAL_SUFFIX = ".partial"
_KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")


@dataclass(frozen=True, slots=True)
class BlobInfo:
    """A blob that exists. `etag` changes whenever the bytes do."""

    key: str
    size: int
    etag: str


@dataclass(frozen=True, slots=True)
class Written:
    """What was written: bytes and their SHA-256 in hexadecimal."""

    size: int
    sha256: str


class Blobs(ABC):
    """Blob storage under keys like `jobs/{job}/result.json`."""

    def __init__(self, spool_dir: Path) -> None:
        self.spool_dir = spool_dir

    def create(self, key: str) -> BlobWriter:
        """A writer whose blob appears under `key` when it is committed, and not at all otherwise."""
        check_key(key)
        return BlobWriter(self, key)

    def put(self, key: str, data: bytes | Iterable[bytes]) -> Written:
        """Store bytes, replacing what was there."""
        with self.create(key) as writer:
            for chunk in (data,) if isinstance(data, bytes) else data:
                writer.write(chunk)
            return writer.commit()

    def upload(self, path: Path, key: str) -> Written:
        """Copy a local file into the storage."""
        with path.open("rb") as file:
            return self.put(key, iter(lambda: file.read(CHUNK), b""))

    def fetch(self, key: str, path: Path) -> Written:
        """Copy a blob to a local path, whole or not at all. The folder is made if need be."""
        part = path.with_name(path.name + ".part")
        digest, size = hashlib.sha256(), 0
        chunks = self.stream(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as file:
                for chunk in chunks:
                    file.write(chunk)
                    digest.update(chunk)
                    size += len(chunk)
            part.replace(path)
        except OSError as error:
            raise translated(error) from error
        finally:
            part.unlink(missing_ok=True)
        return Written(size, digest.hexdigest())

    def get(self, key: str) -> bytes:
        """All bytes of a small blob."""
        return b"".join(self.stream(key))

    def exists(self, key: str) -> bool:
        """Whether a blob has this key."""
        try:
            self.head(key)
        except BlobNotFound:
            return False
        return True

    @abstractmethod
    def put_if_absent(self, key: str, data: bytes) -> bool:
        """Store a small blob unless the key is taken; atomic among all writers. -> whether this call stored it."""

    @abstractmethod
    def stream(self, key: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Bytes `start` up to, not including, `end`, in chunks. BlobNotFound is raised at once."""

    @abstractmethod
    def head(self, key: str) -> BlobInfo:
        """Size and etag; BlobNotFound."""

    @abstractmethod
    def list(self, prefix: str) -> Iterator[BlobInfo]:
        """All blobs below a prefix that ends in `/`, sorted by key."""

    @abstractmethod
    def folders(self, prefix: str) -> Iterator[str]:
        """The next path segments below a prefix that ends in `/`, of whatever lies deeper."""

    @abstractmethod
    def delete(self, key: str) -> None:
        """Remove a blob; no error if there is none."""

    def delete_prefix(self, prefix: str) -> None:
        """Remove everything below a prefix that ends in `/`."""
        for info in list(self.list(prefix)):
            self.delete(info.key)

    def resume(self, key: str, size: int, offset: int, hold: Hold) -> Partial:
        """Go on with a blob of `size` bytes whose first `offset` ones are held; BlobNotFound if they are not.

        Superseded: the row is no longer this holder's.
        """
        check_key(key)
        if not self.is_published(key, size):
            try:
                return self._resume(key, size, offset, hold)
            except BlobNotFound:  # an older request may be giving it its name this moment
                if not self.is_published(key, size):
                    raise
        self.drop_partial(key)  # what was left by one that died right after
        return PublishedPartial(size)

    @abstractmethod
    def drop_partial(self, key: str) -> None:
        """Remove the pieces of a blob that was never published; no error if there are none."""

    def unpublished(self, prefix: str) -> Iterator[Unpublished]:
        """Multipart uploads below a prefix that ends in `/`. They are no blobs, and kept until they are aborted."""
        check_prefix(prefix)
        return iter(())

    def abort(self, found: Unpublished) -> None:  # noqa: B027  a storage without multipart uploads has none to drop
        """Drop the parts of a multipart upload; no error if there are none."""

    def is_published(self, key: str, size: int) -> bool:
        """Whether the whole blob is there."""
        try:
            return self.head(key).size == size
        except BlobNotFound:
            return False

    @abstractmethod
    def check(self) -> None:
        """Raise (with a sentence that says what is wrong) if the storage cannot be used now."""

    def free_bytes(self) -> int:
        """Room on the disk that new blobs pass through."""
        self.spool_dir.mkdir(parents=True, exist_ok=True)
        stat = os.statvfs(self.spool_dir)
        return stat.f_bavail * stat.f_frsize

    def clear_spool(self, older_than: float) -> None:
        """Remove leftovers of killed processes, untouched since `older_than` (seconds since 1970)."""
        for path in self.spool_dir.glob("*.part"):
            with suppress(FileNotFoundError):
                if path.stat().st_mtime >= older_than:
                    continue
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()

    @abstractmethod
    def _resume(self, key: str, size: int, offset: int, hold: Hold) -> Partial:
        """The pieces of a blob that has no name yet."""

    @abstractmethod
    def _publish(self, path: Path, key: str) -> None:
        """Give the durable spool file its name, consuming it or not."""


class BlobWriter:
    """Collects a blob in the spool folder. Leaving the `with` block without `commit` keeps nothing."""

    def __init__(self, blobs: Blobs, key: str) -> None:
        self._blobs = blobs
        self._key = key
        self._digest = hashlib.sha256()
        self.size = 0
        try:
            blobs.spool_dir.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(suffix=".part", dir=blobs.spool_dir)
        except OSError as error:
            raise translated(error) from error
        self._path = Path(name)
        self._file: IO[bytes] = os.fdopen(handle, "wb", buffering=CHUNK)

    def write(self, chunk: bytes) -> None:
        """Append. NoSpace when the disk is full."""
        try:
            self._file.write(chunk)
        except OSError as error:
            raise translated(error) from error
        self._digest.update(chunk)
        self.size += len(chunk)

    @property
    def sha256(self) -> str:
        """The digest of the bytes so far, in hexadecimal."""
        return self._digest.hexdigest()

    def commit(self) -> Written:
        """Make the bytes durable and give them their name."""
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._blobs._publish(self._path, self._key)
        except OSError as error:
            raise translated(error) from error
        finally:
            self.abort()
        return Written(self.size, self.sha256)

    def abort(self) -> None:
        """Drop what was written; nothing happens after a commit."""
        with suppress(OSError):  # flushing what is buffered fails again on a full disk
            self._file.close()
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.abort()


class FolderBlobs(Blobs):
    """Blobs as files below one folder."""

    def __init__(self, root: Path) -> None:
        super().__init__(root / ".spool")  # the same file system, so that publishing is a rename
        self.root = root

    def put_if_absent(self, key: str, data: bytes) -> bool:
        check_key(key)
        self.spool_dir.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(suffix=".part", dir=self.spool_dir)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            self._place(key, lambda target: target.hardlink_to(name))
        except FileExistsError:
            return False
        except OSError as error:
            raise translated(error) from error
        finally:
            Path(name).unlink(missing_ok=True)
        return True

    def stream(self, key: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        try:
            file = self.path(key).open("rb")
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            raise BlobNotFound(key) from None
        return _read(file, start, end)

    def head(self, key: str) -> BlobInfo:
        path = self.path(key)
        try:
            stat = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise BlobNotFound(key) from None
        if not path.is_file():
            raise BlobNotFound(key)
        return BlobInfo(key, stat.st_size, f"{stat.st_mtime_ns:x}-{stat.st_size:x}-{stat.st_ino:x}")

    def list(self, prefix: str) -> Iterator[BlobInfo]:
        # os.walk passes over folders that vanish while it lists: others delete meanwhile.
        walk = os.walk(self.path(check_prefix(prefix)))
        paths = sorted(
            Path(folder, name).relative_to(self.root).as_posix() for folder, _, names in walk for name in names
        )
        for key in paths:
            with suppress(BlobNotFound):
                yield self.head(key)

    def folders(self, prefix: str) -> Iterator[str]:
        with suppress(FileNotFoundError), os.scandir(self.path(check_prefix(prefix))) as entries:
            yield from [entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]

    def delete(self, key: str) -> None:
        path = self.path(key)
        with suppress(FileNotFoundError, IsADirectoryError, NotADirectoryError):
            path.unlink()
        for parent in path.parents:
            if parent == self.root:
                break
            try:
                parent.rmdir()
            except OSError:  # not empty, or not there
                break

    def check(self) -> None:
        try:
            self.spool_dir.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.spool_dir) as file:
                file.write(b"x")
                fcntl.flock(file, fcntl.LOCK_EX)  # as uploads do; some network file systems cannot
        except OSError as error:
            raise BlobsUnavailable(f"the folder {self.root} cannot be written to: {error.strerror}") from error

    def drop_partial(self, key: str) -> None:
        self.delete(key + PARTIAL_SUFFIX)

    def _resume(self, key: str, size: int, offset: int, hold: Hold) -> Partial:
        target = self.path(key)
        path = target.with_name(target.name + PARTIAL_SUFFIX)
        if offset == 0:
            self._place(key, lambda _: path.touch())
        return FolderPartial(path, target, size, offset, hold)

    def _publish(self, path: Path, key: str) -> None:
        self._place(key, path.replace)

    def _place(self, key: str, action: Callable[[Path], object]) -> None:
        """Let a file appear durably. Again if somebody who deletes blobs removed its new folder for being empty."""
        target = self.root / key
        for attempt in range(PLACE_ATTEMPTS):
            try:
                self._make_parents(key)
                action(target)
                break
            except FileNotFoundError:
                if attempt == PLACE_ATTEMPTS - 1:
                    raise
        fsync_dir(target.parent)

    def path(self, key: str) -> Path:
        """Where the blob lies, or would."""
        return self.root / check_key(key)

    def _make_parents(self, key: str) -> None:
        missing = []
        folder = (self.root / key).parent
        while not folder.exists():
            missing.append(folder)
            folder = folder.parent
        for folder in reversed(missing):
            with suppress(FileExistsError):  # `exist_ok` would raise when the other's folder is gone at a second look
                folder.mkdir()
            fsync_dir(folder.parent)


def check_key(key: str) -> str:
    """The key itself if it is made of plain path segments, ValueError otherwise."""
    if not _KEY.fullmatch(key) or len(key) > 900:
        raise ValueError(f"{key!r} is no blob key: use letters, digits, '_', '-', '.' and '/'")
    return key


def check_prefix(prefix: str) -> str:
    """The prefix without its final slash, ValueError if it has none."""
    if not prefix.endswith("/"):
        raise ValueError(f"a prefix ends in '/': {prefix!r}")
    return check_key(prefix[:-1])


def _read(file: IO[bytes], start: int, end: int | None) -> Iterator[bytes]:
    with file:
        file.seek(start)
        left = None if end is None else end - start
        while left is None or left > 0:
            chunk = file.read(CHUNK if left is None else min(CHUNK, left))
            if not chunk:
                return
            if left is not None:
                left -= len(chunk)
            yield chunk
