"""What rows and blobs say of each other: where they disagree, and what mends it.

They part when a backup of one is older than that of the other, when blobs are lost, and when processes that should have
put things right have not run. Looking changes nothing. A mend looks again first, and changes rows as workers and
servers do: both may run meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import func, select, update

from advtex_contract.jobs import TERMINAL, WAITING, JobError, JobState
from advtex_store import keys
from advtex_store.counters import JOBS, count_end
from advtex_store.errors import BlobNotFound, IllegalTransition, NotUnderstood, RecordNotFound, StaleAttempt, StoreError
from advtex_store.ids import ID, created_at
from advtex_store.models import CounterRow, EventRow, JobRow, UploadRow
from advtex_store.partials import Hold
from advtex_store.retention import ORPHAN_SECONDS
from advtex_store.store import Store
from advtex_store.uploads import INCOMPLETE_SECONDS
from advtex_store.webhooks import tell_webhooks

DOCTOR = "advtex-server doctor"
NOT_MENDED = "it has changed meanwhile; nothing was done"


@dataclass(frozen=True, slots=True)
class Disagreement:
    """One job, upload or count that something is wrong with.

    kind: one word for all of its like. mend: does what can be done and says what it was; None where nothing can.
    """

    kind: str
    item: str
    message: str
    mend: Callable[[], str] | None = None


def disagreements(store: Store) -> Iterator[Disagreement]:
    """All of them. Reads every row that is kept, and lists all scans and results once."""
    with store.database.read() as session:  # before the blobs: what a row refers to was there before it
        uploads = session.scalars(select(UploadRow).where(UploadRow.deleted_at.is_(None))).all()
        jobs = session.scalars(select(JobRow).where(JobRow.deleted_at.is_(None))).all()
        now = store.database.now(session)
    sizes = {info.key: info.size for prefix in (keys.SCANS, keys.JOBS) for info in store.blobs.list(prefix)}
    gone = {row.id for row in uploads if row.sha256 and sizes.get(keys.scan_key(row.id)) != row.size}
    yield from _scans(store, gone, jobs)
    yield from _partials(store, uploads)
    yield from _results(store, jobs, sizes)
    for job in jobs:
        if job.state == JobState.running and (job.lease_expires_at or 0.0) < now:
            message = f"attempt {job.attempt} of worker {job.worker} runs, and its lease has run out"
            yield Disagreement("leases", job.id, message, lambda job=job: _give_up(store, job))  # type: ignore[misc]
    yield from _orphans(store, sizes)
    yield from _counters(store)


# -- scans ------------------------------------------------------------------------------------------------------------


def _scans(store: Store, gone: set[str], jobs: Sequence[JobRow]) -> Iterator[Disagreement]:
    for job in jobs:
        if job.upload_id in gone and job.state in WAITING:
            message = f"it waits for a scan whose bytes are gone (upload {job.upload_id})"
            yield Disagreement("scans", job.id, message, lambda job=job: _end_without_scan(store, job))  # type: ignore[misc]
    for upload_id in sorted(gone):
        message = "it is complete, and its bytes are gone"
        yield Disagreement("uploads", upload_id, message, lambda u=upload_id: _ask_again(store, u))  # type: ignore[misc]


def _end_without_scan(store: Store, job: JobRow) -> str:
    """Taken as a worker takes it, so that no worker has it at the same time."""
    message = "the scan is no longer stored; submit it again"
    try:
        store.records.claim(job.id, job.attempt, DOCTOR)
        store.records.fail(job.id, job.attempt, JobError(code="scan_missing", message=message))
    except (StaleAttempt, NotUnderstood):
        return NOT_MENDED
    return "failed: its scan is gone"


def _ask_again(store: Store, upload_id: str) -> str:
    if store.blobs.exists(keys.scan_key(upload_id)):
        return NOT_MENDED
    store.blobs.drop_partial(keys.scan_key(upload_id))
    with store.database.write() as session:
        values = {"sha256": None, "offset": 0, "expires_at": store.database.now(session) + INCOMPLETE_SECONDS}
        session.execute(update(UploadRow).where(UploadRow.id == upload_id).values(**values))
    return "waits for its bytes again: whoever sends the same scan goes on with it"


# -- uploads on their way ---------------------------------------------------------------------------------------------


def _partials(store: Store, uploads: Sequence[UploadRow]) -> Iterator[Disagreement]:
    """More bytes than the row tells of are no harm: the next ones are written over them."""
    for row in uploads:
        if row.sha256 is not None or row.source is not None or row.offset == 0 or _holds(store, row):
            continue
        with suppress(RecordNotFound):
            if store.uploads.upload(row.id).offset != row.offset:
                continue  # it came farther meanwhile
            message = f"its first {row.offset} bytes are not held any more"
            yield Disagreement("partials", row.id, message, lambda row=row: _begin_anew(store, row))  # type: ignore[misc]


def _holds(store: Store, row: UploadRow) -> bool:
    try:
        hold = Hold(str(row.holder), row.kept_by, lambda: None)
        store.blobs.resume(keys.scan_key(row.id), row.size, row.offset, hold).close()
    except BlobNotFound:
        return False
    return True


def _begin_anew(store: Store, row: UploadRow) -> str:
    with store.database.write() as session:
        same = (UploadRow.id == row.id, UploadRow.offset == row.offset, UploadRow.sha256.is_(None))
        begun = update(UploadRow).where(*same).values(offset=0, holder=None, kept_by=None).returning(UploadRow.id)
        if session.scalar(begun) is None:
            return NOT_MENDED
    store.blobs.drop_partial(keys.scan_key(row.id))
    return "begins anew: its client sends it from the first byte on"


# -- results ----------------------------------------------------------------------------------------------------------


def _results(store: Store, jobs: Sequence[JobRow], sizes: Mapping[str, int]) -> Iterator[Disagreement]:
    for job in jobs:
        if job.state != JobState.succeeded:
            continue
        lost = [entry["name"] for entry in job.results if sizes.get(entry["key"]) != entry["size"]]
        if lost:
            message = f"of its {len(job.results)} results {len(lost)} are gone: {', '.join(lost[:3])}"
            yield Disagreement("results", job.id, message, lambda job=job: _make_again(store, job))  # type: ignore[misc]


def _make_again(store: Store, job: JobRow) -> str:
    """The one move that the table of transitions has not: a job that had succeeded has failed after all."""
    message = "the storage has lost some of the results; retry the job, or submit the scan again"
    error = JobError(code="results_lost", message=message).model_dump(mode="json")
    with store.database.write() as session:
        now = store.database.now(session)
        values: dict[str, Any] = {"state": "failed", "error": error, "results": [], "tidied_at": None}
        moved = update(JobRow).where(JobRow.id == job.id, JobRow.state == "succeeded", JobRow.deleted_at.is_(None))
        moved = moved.values(**values, updated_at=now, version=JobRow.version + 1).returning(JobRow)
        row = session.scalar(moved, execution_options={"populate_existing": True, "synchronize_session": False})
        if row is None:
            return NOT_MENDED
        data = {"kind": "state", "state": "failed", "attempt": row.attempt, "at": now}
        session.add(EventRow(job_id=row.id, version=row.version, data=data))
        tell_webhooks(session, row, now)
        count_end(session, row.state, row.error, {})
    store.blobs.delete(keys.result_manifest_key(job.id))  # else the next look would take the job for finished
    if job.source is None and not store.blobs.exists(keys.scan_key(job.upload_id)):
        return "failed: its results are gone, and so is its scan"
    try:
        store.records.retry(job.id)
    except (IllegalTransition, RecordNotFound):
        return NOT_MENDED
    return "queued: its results are made again"


# -- leases, orphans, counts ------------------------------------------------------------------------------------------


def _give_up(store: Store, job: JobRow) -> str:
    """What the servers' reconciler does, without waiting for a while whether what cannot be read can be read again."""
    try:
        if store.results.adopt(job.id):
            return "succeeded: its results were there"
        state = store.records.lost(job.id, job.attempt, expired_only=True)
    except StaleAttempt:
        return NOT_MENDED
    except (StoreError, OSError) as error:
        with suppress(StaleAttempt):
            store.results.end_unread(job.id, job.attempt, error, expired_only=True)
            return f"failed: {error}"
        return NOT_MENDED
    return f"{state}: nobody has its attempt {job.attempt}"


def _orphans(store: Store, sizes: Mapping[str, int]) -> Iterator[Disagreement]:
    """Never removed here: after a restore they may be all that is left of what the rows have forgotten."""
    tables: tuple[tuple[str, type[JobRow] | type[UploadRow]], ...] = ((keys.SCANS, UploadRow), (keys.JOBS, JobRow))
    for prefix, table in tables:
        found: dict[str, list[int]] = {}
        for key, size in sizes.items():
            owner = key.removeprefix(prefix).partition("/")[0]
            if key.startswith(prefix) and ID.fullmatch(owner):
                found.setdefault(owner, []).append(size)
        with store.database.read() as session:  # after the blobs: a row is there before them
            known = set(session.scalars(select(table.id)))
        for owner in sorted(found.keys() - known):
            end = datetime.fromtimestamp(created_at(owner) + ORPHAN_SECONDS, UTC)
            message = f"{len(found[owner])} blobs ({sum(found[owner])} bytes) below {prefix}{owner}/ have no row; "
            yield Disagreement("orphans", owner, f"{message}servers remove them from {end:%Y-%m-%d %H:%M} UTC on")


def _counters(store: Store) -> Iterator[Disagreement]:
    """No fewer jobs can have ended in a state than are in it; more can, since jobs are retried."""
    ended = select(JobRow.state, func.count()).where(JobRow.state.in_(TERMINAL)).group_by(JobRow.state)
    with store.database.read() as session:
        rows = {state: int(count) for state, count in session.execute(ended)}
        told = {row.label: row.count for row in session.scalars(select(CounterRow).where(CounterRow.name == JOBS))}
    for state, count in sorted(rows.items()):
        if told.get(state, 0) < count:
            message = f"{told.get(state, 0)} jobs are counted as {state}, and {count} are"
            yield Disagreement("counters", state, message, lambda s=state, n=count: _count(store, s, n))  # type: ignore[misc]


def _count(store: Store, state: str, count: int) -> str:
    with store.database.write() as session:
        row = session.get(CounterRow, (JOBS, state), with_for_update=True)
        if row is None:
            session.add(CounterRow(name=JOBS, label=state, count=count, total=0.0))
        else:
            row.count = max(row.count, count)
    return f"counted: {count}"
