"""The use cases of the API, without HTTP. All calls block; routes make them in threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

import structlog

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
)
from advtex_contract.live import LiveImage, LiveRecord, LiveView
from advtex_contract.stored_options import read_options
from advtex_options import refusal
from advtex_options.outputs import kind_and_purpose
from advtex_server.batches import BatchService
from advtex_server.loops import Loop
from advtex_server.older_clients import told
from advtex_server.refusal import ApiError
from advtex_server.settings import ServerSettings
from advtex_server.waiting import is_late, tell_why, waiting_reason
from advtex_store import keys
from advtex_store.accounts import Caller
from advtex_store.errors import BlobNotFound, ReferenceRefused
from advtex_store.models import JobRow
from advtex_store.results import StoredFile
from advtex_store.store import Store
from advtex_store.submissions import JobFilter, Reservation
from advtex_store.tracing import OFF, Traces

log = structlog.get_logger("advtex.server")


class Service:
    """What a caller can do. `wake` is called when there is a scan to check, or a job for the workers.

    loops: what goes on in the background of the same process.
    """

    def __init__(
        self,
        store: Store,
        settings: ServerSettings,
        wake: Callable[[], None] = lambda: None,
        traces: Traces = OFF,
        loops: Sequence[Loop] = (),
    ) -> None:
        self.store = store
        self.loops = loops
        self.settings = settings
        self.wake = wake
        self.traces = traces
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
            max_running_jobs=caller.max_running_jobs,
        )

    # -- jobs -----------------------------------------------------------------------------------------------------

    def create_job(self, caller: Caller, spec: JobSpec, token: str | None) -> tuple[JobView, bool]:
        """A job whose scan is checked next. -> the job, and whether it is new."""
        owner, most = caller.owner, self.settings.max_retention_seconds
        if spec.retention_seconds is not None and spec.retention_seconds > most:
            raise ApiError(ErrorCode.bad_request, f"retention_seconds: jobs are kept for {most} s at most", status=422)
        reservation: Reservation | None = None
        if token is not None:
            held = self.store.submissions.reserve(owner, token, spec)
            if isinstance(held, JobRow):
                if held.deleted_at is not None:
                    raise ApiError(ErrorCode.conflict, "the job of this idempotency key was deleted; use a new key")
                return told(job_view(held)), False
            reservation = held
        try:
            _check_method(spec.options.method)
            span = self.traces.span("submit", self._look(owner, spec), owner=owner, batch=spec.batch)
            row = self.store.submissions.create_job(
                owner,
                spec,
                reservation=reservation,
                max_active_jobs=caller.max_active_jobs,
                traceparent=span.traceparent,
            )
            span.end(job=row.id)
        except BaseException:
            if reservation is not None:
                self.store.submissions.release(reservation)
            raise
        log.info("job created", job=row.id, upload=row.upload_id)
        self.wake()
        return told(job_view(row)), True

    def job(self, owner: str, job_id: str) -> JobView:
        return told(job_view(self.newest(owner, job_id)))

    def newest(self, owner: str, job_id: str) -> JobRow:
        """The row with the progress of this moment."""
        row = self.store.records.job(job_id, owner)
        self.store.live_progress.show([row])
        tell_why(self.store, owner, [row])
        return row

    def jobs(self, owner: str, wanted: JobFilter, cursor: str | None, limit: int) -> JobPage:
        rows, following = self.store.submissions.list_jobs(owner, wanted, cursor=cursor, limit=limit)
        self.store.live_progress.show(rows)
        tell_why(self.store, owner, rows)
        return JobPage(jobs=[told(job_view(row)) for row in rows], next_cursor=following)

    def cancel(self, owner: str, job_id: str) -> JobView:
        view = told(job_view(self.store.records.cancel(job_id, owner)))
        log.info("cancel asked", job=job_id, state=view.state)
        return view

    def retry(self, caller: Caller, job_id: str) -> JobView:
        row = self.store.records.retry(job_id, caller.owner, max_active_jobs=caller.max_active_jobs)
        log.info("retry", job=job_id)
        self.wake()
        return told(job_view(row))

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

    def link(self, caller: Caller, job_id: str, name: str) -> str:
        """An address of a file of a succeeded job that asks for no key, for some minutes."""
        self.result(caller.owner, job_id, name)
        token = self.store.links.make(caller.key_id, job_id, name)
        return f"/links/{token}/{job_id}/{quote(name)}"

    def linked(self, token: str, job_id: str, name: str) -> StoredFile:
        """The file of such an address. Whatever is wrong with it is told in the same words."""
        owner = self.store.links.owner(token, job_id, name)
        if owner is None:
            raise ApiError(ErrorCode.not_found, "this link is wrong or too old; ask for a new one")
        return self.result(owner, job_id, name)

    def live(self, owner: str, job_id: str) -> LiveView:
        """What the job's texture looks like now."""
        record = self._live_record(owner, job_id)
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
        record = self._live_record(owner, job_id)
        for picture in record.pictures if record else ():
            if picture.name == name:
                return picture.jpeg
        raise ApiError(ErrorCode.not_found, f"job {job_id} has no live picture {name!r} now")

    # -- inside ---------------------------------------------------------------------------------------------------

    def _live_record(self, owner: str, job_id: str) -> LiveRecord | None:
        row = self.store.records.job(job_id, owner)
        return None if row.state == JobState.succeeded else self.store.live.read(job_id, row.attempt)

    def _look(self, owner: str, spec: JobSpec) -> str | None:
        """What can be said of the scan without reading it: whether it is there, and may be read. -> its traceparent"""
        if spec.source is not None:
            try:
                self.store.references.look(spec.source)
            except (BlobNotFound, ReferenceRefused) as error:
                remedy = "give the URL of a scan that the server can read, or upload it"
                detail = ErrorDetail(code="source", where="body.source", message=str(error), remedy=remedy)
                raise ApiError(ErrorCode.invalid_source, str(error), [detail]) from error
            return None
        assert spec.upload_id is not None
        upload = self.store.uploads.upload(spec.upload_id, owner)
        if upload.sha256 is None:
            state = f"{upload.offset} of {upload.size}"
            raise ApiError(ErrorCode.not_ready, f"upload {upload.id} is not complete: {state}")
        self.store.blobs.head(keys.scan_key(upload.id))
        return upload.traceparent


def job_view(row: JobRow) -> JobView:
    """The row as the API shows it."""
    state = row.state
    return JobView(
        id=row.id,
        state=state,
        label=row.label,
        upload_id=row.upload_id,
        source=row.source,
        batch=row.batch,
        options=read_options(row.options),
        priority=row.priority,
        attempt=row.attempt - 1 if state in WAITING else row.attempt,
        waiting_reason=waiting_reason(row),
        memory_bytes=row.memory_bytes,
        progress=Progress.model_validate(row.progress),
        warnings=[ErrorDetail.model_validate(w) for w in row.warnings],
        error=JobError.model_validate(row.error) if row.error else None,
        results=[_result_file(row.id, stored) for stored in row.results],
        created_at=_time(row.created_at),
        updated_at=_time(row.updated_at),
        finished_at=_time(row.finished_at) if row.finished_at else None,
        retention_seconds=row.retention_seconds,
        expires_at=_time(row.expires_at) if row.expires_at else None,
        deadline=_time(row.deadline) if row.deadline is not None else None,
        late=is_late(row),
    )


def _result_file(job_id: str, stored: Mapping[str, Any]) -> ResultFile:
    kind, purpose = kind_and_purpose(stored["name"])
    return ResultFile(
        name=stored["name"],
        size=stored["size"],
        sha256=stored["sha256"],
        content_type=stored["content_type"],
        url=f"/v1/jobs/{job_id}/results/{quote(stored['name'])}",
        kind=kind,
        purpose=purpose,
    )


def _check_method(name: str | None) -> None:
    """Refuse a method that is not known here, before anything is done for it."""
    if name is not None and (words := refusal("method", name)) is not None:
        where, remedy = "body.options.method", "choose one of these, or ask the operator to install the package"
        detail = ErrorDetail(code="unknown_method", where=where, message=words, remedy=remedy)
        raise ApiError(ErrorCode.invalid_options, f"{where}: {words}", [detail])


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
