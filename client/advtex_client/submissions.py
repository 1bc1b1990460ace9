"""What this computer remembers of its submissions, so that running `submit` again goes on instead of starting over.

One small file per submission, written whole and renamed: a crash leaves the old one or the new one.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import platformdirs
from pydantic import BaseModel, ConfigDict, ValidationError

if sys.platform != "win32":
    import fcntl


def upload_alone(server: str, sha256: str, folder: Path | None = None) -> AbstractContextManager[None]:
    """Let one run at a time send these bytes; another would take the upload over from it."""
    place = hashlib.sha256(f"{server}\n{sha256}".encode()).hexdigest()[:32]
    return _locked(_folder(folder) / "uploads" / f"{place}.lock")


def check_writable(folder: Path | None = None) -> Path:
    """Return the folder of what is remembered. Raises OSError if nothing can be written there."""
    place = _folder(folder)
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=place) as file:
        file.write(b"x")
    return place


class Submission(BaseModel):
    """How far a submission came. `salt` sets a job apart from earlier ones of the same scan and options."""

    model_config = ConfigDict(extra="ignore")

    salt: str = ""
    upload_id: str | None = None
    job_id: str | None = None


class SubmissionMemory:
    """The record of one submission on one server. `identity`: what makes it the same one, without line breaks."""

    def __init__(self, server: str, *identity: str, folder: Path | None = None) -> None:
        self._identity = hashlib.sha256("\n".join(identity).encode()).hexdigest()
        place = hashlib.sha256(f"{server}\n{self._identity}".encode()).hexdigest()[:32]
        self.path = _folder(folder) / "submissions" / f"{place}.json"

    def alone(self) -> AbstractContextManager[None]:
        """Wait for other runs of the same submission on this computer, and keep them waiting."""
        return _locked(self.path.with_suffix(".lock"))

    def load(self) -> Submission:
        """Return what is remembered; a fresh record when there is nothing, or nothing that can be read."""
        try:
            return Submission.model_validate_json(self.path.read_bytes())
        except (FileNotFoundError, ValidationError):
            return Submission()

    def save(self, submission: Submission) -> None:
        write_whole(self.path, submission.model_dump_json())

    def idempotency_key(self, submission: Submission) -> str:
        """Return the key that is the same for every try of the same submission."""
        return f"{self._identity[:48]}{submission.salt}"


def write_whole(path: Path, text: str) -> None:
    """Replace a file durably: a crash leaves the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    with os.fdopen(handle, "wb") as file:
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())
    Path(name).replace(path)


def _folder(folder: Path | None) -> Path:
    return folder or platformdirs.user_state_path("advtex")


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        if sys.platform != "win32":  # elsewhere the server alone decides who was first
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
