"""Result files on their way to the disk: a stable `.part`, continued where it stopped, checked, then renamed."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import BinaryIO, Self

import httpx

from advtex_client.errors import IntegrityError, NetworkError, error_from_response
from advtex_contract.jobs import ResultFile

_UNSAFE = re.compile(r'[\x00-\x1f\x7f\\:*?"<>|]')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)

OnFileBytes = Callable[[ResultFile, int], None]
"""Called with the file and its bytes on disk so far."""


def target_path(folder: Path, name: str) -> Path:
    """Return where the server's file `name` goes below `folder`; sub-folders are kept.

    Raises IntegrityError for any name that could leave the folder or that some file system reads in another way.
    """
    parts = name.split("/")
    for part in parts:
        if part in ("", ".", "..") or _UNSAFE.search(part) or _RESERVED.match(part) or part != part.rstrip(". "):
            raise IntegrityError(
                f"the server named a result {name!r}, which is not a safe file name; nothing was written"
            )
    return folder.joinpath(*PurePosixPath(name).parts)


class Download:
    """One file's way to `path`: what to ask for, and what to do with the answer. Used as a context manager.

    The part file's name holds the digest, so it belongs to this content alone, whichever run began it.
    """

    def __init__(self, path: Path, file: ResultFile) -> None:
        self.path = path
        self.file = file
        self.part = path.with_name(f".{path.name}.{file.sha256[:16]}.part")
        self._digest = hashlib.sha256()
        self._sink: BinaryIO | None = None
        self.done = 0
        self._resumed = False

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._sink = self.part.open("a+b")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._sink:
            self._sink.close()

    def load(self) -> None:
        """Read what an earlier run left."""
        assert self._sink is not None
        self._sink.seek(0)
        while chunk := self._sink.read(1 << 20):
            self._digest.update(chunk)
            self.done += len(chunk)
        if self.done > self.file.size:
            self._restart()
        self._resumed = self.done > 0

    @property
    def complete(self) -> bool:
        return self.done == self.file.size

    def headers(self) -> dict[str, str]:
        """Ask for what is missing; the ETag of a result is its digest, so another content comes whole."""
        base = {"Accept-Encoding": "identity"}
        if self.done:
            base |= {"Range": f"bytes={self.done}-", "If-Range": f'"{self.file.sha256}"'}
        return base

    def begin(self, response: httpx.Response) -> None:
        """Look at the answer before its body is written. Raises what the server said when it sends no bytes."""
        if response.status_code == 206:
            if not response.headers.get("Content-Range", "").startswith(f"bytes {self.done}-"):
                raise NetworkError(f"{self.file.name}: the server sent another range than was asked for")
        elif response.status_code == 416:
            self._restart()
            raise NetworkError(f"{self.file.name}: the server has no such range")
        elif not response.is_success:
            raise error_from_response(response)
        elif self.done:
            self._restart()

    def write(self, chunk: bytes) -> None:
        assert self._sink is not None
        self._sink.write(chunk)
        self._digest.update(chunk)
        self.done += len(chunk)

    def finish(self) -> Path:
        """Check size and digest, then rename. Raises NetworkError where another try helps, else IntegrityError."""
        assert self._sink is not None
        self._sink.flush()
        if self.done < self.file.size:
            raise NetworkError(
                f"{self.file.name} ended after {self.done} of {self.file.size} bytes; run it again to go on"
            )
        if self._digest.hexdigest() != self.file.sha256:
            resumed = self._resumed
            self._restart()
            if resumed:  # the part that an earlier run left may be the damaged one
                raise NetworkError(f"{self.file.name}: the part on disk did not fit its rest")
            raise IntegrityError(
                f"{self.file.name} does not match its sha256; the copy was thrown away, download it again"
            )
        os.fsync(self._sink.fileno())
        self._sink.close()
        self.part.replace(self.path)
        return self.path

    def _restart(self) -> None:
        assert self._sink is not None
        self._sink.truncate(0)
        self._sink.seek(0)
        self._digest = hashlib.sha256()
        self.done = 0
        self._resumed = False


def is_there(path: Path, file: ResultFile) -> bool:
    """Tell whether `path` already holds exactly this content."""
    if not path.is_file() or path.stat().st_size != file.size:
        return False
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest() == file.sha256
