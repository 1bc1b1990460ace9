"""Results: files of the attempt that won, behind one manifest that is written last and once."""

from __future__ import annotations

import mimetypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from pydantic import BaseModel, ValidationError

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import JobError
from advtex_store import keys
from advtex_store.blobs import Blobs
from advtex_store.errors import BlobNotFound, IllegalTransition, ResultsUnreadable
from advtex_store.records import Records

CONTENT_TYPES = {
    ".glb": "model/gltf-binary",
    ".obj": "model/obj",
    ".mtl": "model/mtl",
    ".usdz": "model/vnd.usdz+zip",
    ".3tz": "application/vnd.maxar.archive.3tz+zip",
    ".mjpeg": "video/x-motion-jpeg",
    ".log": "text/plain",
}


class StoredFile(BaseModel):
    """One result: its name for users, its blob, and what is in it."""

    name: str
    key: str
    size: int
    sha256: str
    content_type: str


class ResultManifest(BaseModel):
    """`jobs/{job}/result.json`: whoever creates it has finished the job."""

    attempt: int
    files: list[StoredFile]
    warnings: list[ErrorDetail] = []


class Results:
    """Commit of a job's results."""

    def __init__(self, records: Records, blobs: Blobs) -> None:
        self.records = records
        self.blobs = blobs

    def commit(
        self,
        job_id: str,
        attempt: int,
        files: Mapping[str, Path],
        warnings: Sequence[ErrorDetail] = (),
        *,
        closing: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> ResultManifest:
        """Upload `files` (name for the user -> local path) and end the job as `succeeded`, the latter within `closing`.

        Returns the manifest that counts: an earlier attempt's, if that one had written its manifest first.
        StaleAttempt: the lease was lost before anything could be seen.
        """
        stored = []
        for name, path in files.items():
            key = keys.result_key(job_id, attempt, name)
            written = self.blobs.upload(path, key)
            stored.append(
                StoredFile(
                    name=name, key=key, size=written.size, sha256=written.sha256, content_type=content_type(name)
                )
            )
            self.records.lease(job_id, attempt)
        manifest = ResultManifest(attempt=attempt, files=stored, warnings=list(warnings))
        self.records.heartbeat(job_id, attempt)
        if not self.blobs.put_if_absent(keys.result_manifest_key(job_id), manifest.model_dump_json().encode()):
            manifest = self.manifest(job_id)
        with closing():
            self.records.succeed(job_id, attempt, [f.model_dump() for f in manifest.files], manifest.warnings)
        return manifest

    def adopt(self, job_id: str) -> bool:
        """End the job as `succeeded` if its manifest exists already. -> whether it does."""
        try:
            manifest = self.manifest(job_id)
        except BlobNotFound:
            return False
        try:
            self.records.succeed(job_id, None, [f.model_dump() for f in manifest.files], manifest.warnings)
        except IllegalTransition:
            return self.records.job(job_id).state == "succeeded"
        return True

    def end_unread(self, job_id: str, attempt: int, error: Exception, *, expired_only: bool = False) -> None:
        """End a job of which `error` keeps everybody from reading whether it has finished; as `failed`, since nobody
        can go on with it.

        A retry makes the results again if their list is damaged, which goes for that, and else adopts them if they can
        be read by then. expired_only, StaleAttempt: as of `Records.lost`.
        """
        if isinstance(error, ResultsUnreadable):
            ending = JobError(code="results_lost", message=f"{error}; retry the job, and they are made again")
        else:
            message = f"it may have finished, but its results cannot be read: {type(error).__name__}: {error}"
            ending = JobError(code="storage_refused", message=f"{message}; retry the job once the storage is mended")
        self.records.fail(job_id, attempt, ending, expired_only=expired_only)
        if isinstance(error, ResultsUnreadable):
            self.blobs.delete(keys.result_manifest_key(job_id))

    def manifest(self, job_id: str) -> ResultManifest:
        """The manifest. BlobNotFound, ResultsUnreadable."""
        data = self.blobs.get(key := keys.result_manifest_key(job_id))
        try:
            return ResultManifest.model_validate_json(data)
        except ValidationError:
            raise ResultsUnreadable(f"the list of the job's results is damaged ({key}, {len(data)} bytes)") from None


def content_type(name: str) -> str:
    """By the name's ending."""
    return CONTENT_TYPES.get(Path(name).suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
