"""The use cases of the API, without HTTP. All calls block; routes make them in threads."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

import structlog
from sqlalchemy.exc import SQLAlchemyError

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.health import KeyView
from advtex_contract.jobs import (
    WAITING,
    JobError,
    JobPage,
    JobSpec,
    JobState,
    JobView,
    Progress,
    ResultFile,
    StorageInfo,
    known_options,
)
from advtex_contract.live import LiveImage, LiveRecord, LiveView
from advtex_contract.options import JobOptions
from advtex_scan.check import check_scan
from advtex_server.batches import BatchService
from advtex_server.refusal import ApiError
from advtex_server.settings import ServerSettings
from advtex_store import keys
from advtex_store.accounts import Caller
from advtex_store.blobs import FolderBlobs
from advtex_store.errors import BlobNotFound, ReferenceRefused, StoreError
from advtex_store.models import JobRow
from advtex_store.needs import needed_memory
from advtex_store.results import StoredFile
from advtex_store.store import Store
from advtex_store.submissions import HOLD_SECONDS, JobFilter, Reservation

IN_LINE = "a worker takes it when its turn comes"

log = structlog.get_logger("advtex.server")


class Service:
    """What a caller can do. `wake` is called when a job has been queued."""

    def __init__(self, store: Store, settings: ServerSettings, wake: Callable[[], None] = lambda: None) -> None:
        self.store = store
        self.settings = settings
        self.wake = wake
        self.batches = BatchService(store, wake)

    def storage(self) -> StorageInfo:
        return StorageInfo(
            max_upload_bytes=self.settings.max_upload_bytes,
            retention_seconds=self.settings.retention_seconds,
            max_retention_seconds=self.settings.max_retention_seconds,
        )

    def key(self, caller: Caller) -> KeyView:
        usage = self.store.accounts.usage(caller.owner)
        return KeyView(
            id=caller.key_id,
            scopes=sorted(caller.scopes),
            expires_at=None if caller.expires_at is None else _time(caller.expires_at),
            active_jobs=usage.active_jobs,
            max_active_jobs=caller.max_active_jobs,
            bytes=usage.bytes,
            max_bytes=caller.max_bytes,
        )

    # -- jobs -----------------------------------------------------------------------------------------------------

    def create_job(self, caller: Caller, spec: JobSpec, token: str | None) -> tuple[JobView, bool]:
        """Check the scan and queue the job, or record it as rejected. -> the job, and whether it is new."""
        owner, most = caller.owner, self.settings.max_retention_seconds
        if spec.retention_seconds is not None and spec.retention_seconds > most:
            raise ApiError(ErrorCode.bad_request, f"retention_seconds: jobs are kept for {most} s at most", status=422)
        reservation: Reservation | None = None
        if token is not None:
            held = self.store.submissions.reserve(owner, token, hashlib.sha256(_canonical(spec)).hexdigest())
            if isinstance(held, JobRow):
                if held.deleted_at is not None:
                    raise ApiError(ErrorCode.conflict, "the job of this idempotency key was deleted; use a new key")
                return job_view(held), False
            reservation = held
        try:
            with self._holding(reservation):
                row = self._checked_job(caller, spec, reservation)
        except BaseException:
            if reservation is not None:
                self.store.submissions.release(reservation)
            raise
        log.info("job created", job=row.id, state=row.state, upload=row.upload_id)
        self.wake()
        return job_view(row), True

    def job(self, owner: str, job_id: str) -> JobView:
        return job_view(self.store.records.job(job_id, owner))

    def jobs(self, owner: str, wanted: JobFilter, cursor: str | None, limit: int) -> JobPage:
        rows, following = self.store.submissions.list_jobs(owner, wanted, cursor=cursor, limit=limit)
        return JobPage(jobs=[job_view(row) for row in rows], next_cursor=following)

    def cancel(self, owner: str, job_id: str) -> JobView:
        view = job_view(self.store.records.cancel(job_id, owner))
        log.info("cancel asked", job=job_id, state=view.state)
        return view

    def retry(self, caller: Caller, job_id: str) -> JobView:
        view = job_view(self.store.records.retry(job_id, caller.owner, max_active_jobs=caller.max_active_jobs))
        log.info("retry", job=job_id)
        self.wake()
        return view

    def delete(self, owner: str, job_id: str) -> None:
        self.store.records.delete(job_id, owner)
        log.info("job deleted", job=job_id)

    def result(self, owner: str, job_id: str, name: str) -> StoredFile:
        """A file of a succeeded job."""
        row = self.store.records.job(job_id, owner)
        for entry in row.results:
            if entry["name"] == name:
                return StoredFile.model_validate(entry)
        if row.state != JobState.succeeded:
            raise ApiError(ErrorCode.not_ready, f"job {job_id} is {row.state}: it has no results")
        raise ApiError(ErrorCode.not_found, f"job {job_id} has no result {name!r}")

    def live(self, owner: str, job_id: str) -> LiveView:
        """What the job's texture looks like now."""
        record = self._look(owner, job_id)
        if record is None:
            return LiveView()
        # The step makes the address a new one, so that no cache answers with an older picture.
        base, query = f"/v1/jobs/{job_id}/live", f"step={record.step}"
        images = [
            LiveImage(name=picture.name, view=picture.view, href=f"{base}/{picture.name}?{query}")
            for picture in record.pictures
        ]
        return LiveView(step=record.step, curves=record.curves, images=images)

    def live_picture(self, owner: str, job_id: str, name: str) -> bytes:
        """A JPEG of `live`."""
        record = self._look(owner, job_id)
        for picture in record.pictures if record else ():
            if picture.name == name:
                return picture.jpeg
        raise ApiError(ErrorCode.not_found, f"job {job_id} has no live picture {name!r} now")

    # -- inside ---------------------------------------------------------------------------------------------------

    def _look(self, owner: str, job_id: str) -> LiveRecord | None:
        row = self.store.records.job(job_id, owner)
        return None if row.state == JobState.succeeded else self.store.live.read(job_id, row.attempt)

    @contextmanager
    def _holding(self, reservation: Reservation | None) -> Iterator[None]:
        """The check of a large scan takes longer than a reservation lasts: a thread renews it meanwhile."""
        if reservation is None:
            yield
            return
        done = threading.Event()

        def renew() -> None:
            while not done.wait(HOLD_SECONDS / 3):
                with suppress(SQLAlchemyError, StoreError):
                    self.store.submissions.renew(reservation)

        thread = threading.Thread(target=renew, name="reservation", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def _checked_job(self, caller: Caller, spec: JobSpec, reservation: Reservation | None) -> JobRow:
        owner = caller.owner
        with self._local_scan(owner, spec) as path:
            report = check_scan(path, spec.options.layout)
        details = [
            ErrorDetail(severity=f.severity, code=f.code, where=f.where, message=f.message, remedy=f.remedy)
            for f in report.findings
        ]
        if report.ok:
            return self.store.submissions.create_job(
                owner,
                spec,
                warnings=details,
                reservation=reservation,
                memory_bytes=needed_memory(
                    spec.options, report.frames_usable, *report.view_size, fuses=report.mesh is None
                ),
                max_active_jobs=caller.max_active_jobs,
            )
        rejection = _rejection(details)
        return self.store.submissions.create_job(owner, spec, rejection=rejection, reservation=reservation)

    @contextmanager
    def _local_scan(self, owner: str, spec: JobSpec) -> Iterator[Path]:
        """The scan as a file or folder of this machine."""
        blobs = self.store.blobs
        blobs.spool_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(suffix=".part", dir=blobs.spool_dir) as folder:
            if spec.source is not None:
                yield self._referred(spec.source, Path(folder))
                return
            assert spec.upload_id is not None
            upload = self.store.uploads.upload(spec.upload_id, owner)
            if upload.sha256 is None:
                state = f"{upload.offset} of {upload.size}"
                raise ApiError(ErrorCode.not_ready, f"upload {upload.id} is not complete: {state}")
            key = keys.scan_key(upload.id)
            if not isinstance(blobs, FolderBlobs):
                blobs.fetch(key, Path(folder) / "scan.zip")
                yield Path(folder) / "scan.zip"
            elif blobs.exists(key):
                yield blobs.path(key)
            else:
                raise BlobNotFound(key)

    def _referred(self, source: str, folder: Path) -> Path:
        try:
            return self.store.references.fetch(source, folder)
        except (BlobNotFound, ReferenceRefused) as error:
            remedy = "give the URL of a scan that the server can read, or upload it"
            detail = ErrorDetail(code="source", where="body.source", message=str(error), remedy=remedy)
            raise ApiError(ErrorCode.invalid_source, str(error), [detail]) from error


def _rejection(details: list[ErrorDetail]) -> JobError:
    errors = [detail for detail in details if detail.severity == "error"]
    more = f" (and {len(errors) - 1} more problems)" if len(errors) > 1 else ""
    first = f"{errors[0].where} {errors[0].message}".lstrip()  # some are of the scan as a whole
    message = f"the scan cannot be textured: {first}{more}"
    return JobError(code=ErrorCode.invalid_scan, message=message, details=details)


def job_view(row: JobRow) -> JobView:
    """The row as the API shows it."""
    state = row.state
    paused = row.waiting_reason if state == JobState.running else ""
    results = [
        ResultFile(
            name=f["name"],
            size=f["size"],
            sha256=f["sha256"],
            content_type=f["content_type"],
            url=f"/v1/jobs/{row.id}/results/{quote(f['name'])}",
        )
        for f in row.results
    ]
    return JobView(
        id=row.id,
        state=state,
        label=row.label,
        upload_id=row.upload_id,
        source=row.source,
        batch=row.batch,
        options=JobOptions.model_validate(known_options(row.options)),
        priority=row.priority,
        attempt=row.attempt - 1 if state in WAITING else row.attempt,
        waiting_reason=(row.waiting_reason or IN_LINE) if state in WAITING else paused,
        memory_bytes=row.memory_bytes,
        progress=Progress.model_validate(row.progress),
        warnings=[ErrorDetail.model_validate(w) for w in row.warnings],
        error=JobError.model_validate(row.error) if row.error else None,
        results=results,
        created_at=_time(row.created_at),
        updated_at=_time(row.updated_at),
        finished_at=_time(row.finished_at) if row.finished_at else None,
        retention_seconds=row.retention_seconds,
        expires_at=_time(row.expires_at) if row.expires_at else None,
    )


def _canonical(spec: JobSpec) -> bytes:
    return spec.model_dump_json().encode()


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
