"""Job rows, and what may become of them (`STATES` in `advtex_contract.jobs`).

How a worker carries a job (`store = open_store(settings)`; RQ calls `advtex_worker.tasks.run_job(job_id, attempt)`):

1. `claim = store.records.claim(job_id, attempt, worker)`. `StaleAttempt` here means that somebody else has the job or
   that it was canceled: return quietly, it is not an error. `NotUnderstood`: `records.decline`, and leave it to a
   worker that knows its options.
2. `if store.results.adopt(job_id): return`: an earlier attempt had already finished, only its row was not told.
3. Fetch the scan: `store.blobs.fetch(claim.scan_key, path)`. Resume: the files that the index of the newest attempt
   names (`keys.py`; the worker writes and reads the indexes).
4. Every half second, and from a thread that does not wait for the engine: `store.live_progress.tell(…)` for those who
   watch, and `lease = store.records.lease(job_id, attempt)`, which writes nothing; every few seconds instead of that
   `store.records.heartbeat(job_id, attempt, progress=…, reached=…)`. `lease.cancel_requested` -> stop the engine with a
   checkpoint. `StaleAttempt` -> the lease is lost: stop at once, upload nothing more. A heartbeat that fails because
   the database is away is no loss: try again until `lease_seconds` have passed since the last good one.
5. A checkpoint: its new files below `keys.checkpoint_prefix(job_id, attempt)`, under names that are never used again,
   then the index that names them, in one go; only then go files that no index of this attempt names any more.
6. The end, one of
   - `store.results.commit(job_id, attempt, {name: path}, warnings)`: uploads the files, writes the manifest once,
     marks the job `succeeded`;
   - `records.fail(job_id, attempt, error)`: it would fail again in the same way;
   - `records.reject(job_id, attempt, error)`: the scan is bad;
   - `records.canceled(job_id, attempt)`: after the checkpoint of a cancel;
   - `records.preempt(job_id, attempt)`: SIGTERM: back to the front of the queue, never counted as a failure;
   - `records.lost(job_id, attempt, log_tail=…)`: the process that ran the engine died. Goes on with the next attempt
     and gives the job up (`poison`) after three such deaths without progress. A worker that dies as a whole calls
     nothing: the server's reconciler calls `lost` when the lease has run out.

Every one of these carries the attempt's number; `StaleAttempt` is raised when it is no longer the job's current one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import and_, func, select, update
from sqlalchemy.orm import Session

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import RETRYABLE, TERMINAL, WAITING, JobError, JobState, Progress
from advtex_contract.options import JobOptions, known_options, misunderstood
from advtex_store import keys
from advtex_store.accounts import check_active_jobs
from advtex_store.counters import ATTEMPTS, BYTES, RESULT_UP, count_one
from advtex_store.database import Database
from advtex_store.errors import IllegalTransition, NotUnderstood, StaleAttempt
from advtex_store.fair_queue import Gaze, WaitingJob, distinct_pairs, next_jobs, use_order_of_index
from advtex_store.lines import read_holds
from advtex_store.memory_estimate import GIB
from advtex_store.models import KEPT, WAITS_FOR_A_REASON, EventRow, JobRow
from advtex_store.transitions import Transitions, held, record_event
from advtex_store.troubles import ADOPT, not_aside

S = JobState
POISON_DEATHS = 3
DECLINED = "a worker does not understand its options, upgrade it or install the package of the method: "
EXPLAINED = 1000  # waiting rows that are told in one go why they wait


@dataclass(frozen=True, slots=True)
class Lease:
    """What a heartbeat answers: seconds since 1970 until which the job is held, and whether the user wants it ended."""

    expires_at: float
    cancel_requested: bool


@dataclass(frozen=True, slots=True)
class Claim:
    """A job that this worker now holds."""

    job_id: str
    attempt: int
    owner: str
    upload_id: str
    scan_key: str
    source: str | None
    options: JobOptions
    progress: Progress  # of earlier attempts
    lease: Lease
    traceparent: str | None = None
    waiting_since: float | None = None  # of a job that has a trace


class Records(Transitions):
    """Jobs in the database, for workers, dispatcher and users."""

    def __init__(self, database: Database, *, lease_seconds: float = 60.0) -> None:
        super().__init__(database)
        self.lease_seconds = lease_seconds
        self._gaze = Gaze()

    # -- worker ---------------------------------------------------------------------------------------------------

    def claim(self, job_id: str, attempt: int, worker: str, lease_seconds: float | None = None) -> Claim:
        """Take a waiting job. StaleAttempt: it is not waiting for this attempt (any more). NotUnderstood: see there."""
        with self.database.write() as session:
            expires_at = self.database.now(session) + (lease_seconds or self.lease_seconds)
            row = self.move(
                session,
                job_id,
                S.running,
                fence=attempt,
                worker=worker[:255],
                lease_expires_at=expires_at,
                reached_at_claim=JobRow.reached,
                waiting_reason="",
            )
            if (reason := misunderstood(row.options)) is not None:
                raise NotUnderstood(reason)
            return Claim(
                job_id=row.id,
                attempt=row.attempt,
                owner=row.owner,
                upload_id=row.upload_id,
                scan_key=keys.scan_key(row.upload_id),
                source=row.source,
                options=JobOptions.model_validate(known_options(row.options)),
                progress=Progress.model_validate(row.progress),
                lease=Lease(expires_at, row.cancel_requested),
                traceparent=row.traceparent,
                waiting_since=None if row.traceparent is None else _waiting_since(session, row),
            )

    def decline(self, job_id: str, attempt: int, reason: str) -> None:
        """Leave a waiting job to another worker, and tell why it waits; its attempt is still to come."""
        told = f"{DECLINED}{reason}"[:255]
        mine = and_(JobRow.id == job_id, JobRow.attempt == attempt, JobRow.state.in_(WAITING))
        with self.database.write() as session:
            values = {"waiting_reason": told, "version": JobRow.version + 1, "updated_at": self.database.now(session)}
            session.execute(update(JobRow).where(mine, JobRow.waiting_reason != told).values(**values))

    def lease(self, job_id: str, attempt: int) -> Lease:
        """The lease as it is, without a commit. StaleAttempt: it is lost."""
        with self.database.read() as session:
            query = select(JobRow.lease_expires_at, JobRow.cancel_requested).where(held(job_id, attempt))
            found = session.execute(query).one_or_none()
            if found is None:
                raise StaleAttempt(self._why_stale(session, job_id, attempt))
            return Lease(found.lease_expires_at or 0.0, found.cancel_requested)

    def heartbeat(
        self,
        job_id: str,
        attempt: int,
        progress: Progress | None = None,
        *,
        stages: Sequence[Progress] = (),
        reached: int = 0,
        lease_seconds: float | None = None,
        log_tail: str | None = None,
        waiting_reason: str | None = None,
        moved: Mapping[str, int] | None = None,
    ) -> Lease:
        """Keep the lease and tell how far the attempt is. StaleAttempt: the lease is lost.

        stages: how each stage began that did so since the last heartbeat.
        reached: any number that grows with the work and means the same in every attempt (say, stage index times
        10^7 plus step). Deaths count towards poison only while no attempt gets farther than the ones before.
        log_tail: the newest lines of the engine's log, shown if the job has to be given up.
        waiting_reason: why the attempt pauses, in words; empty when it does not.
        moved: bytes since the last heartbeat (`counters.MOVES`); those of results are counted when it succeeds.
        """
        with self.database.write() as session:
            now = self.database.now(session)
            row = self._running(session, job_id, attempt)
            row.lease_expires_at = now + (lease_seconds or self.lease_seconds)
            row.reached = max(row.reached, reached)
            if log_tail is not None:
                row.log_tail = log_tail
            if waiting_reason is not None and (reason := waiting_reason[:255]) != row.waiting_reason:
                row.waiting_reason, row.updated_at, row.version = reason, now, row.version + 1
            for told in stages if progress is None else (*stages, progress):
                if (data := told.model_dump(mode="json")) == row.progress:
                    continue
                stage_changed = told.stage != row.progress.get("stage")
                row.progress, row.updated_at, row.version = data, now, row.version + 1
                if stage_changed:
                    record_event(session, row, "progress", {name: data[name] for name in data if name != "notes"})
            for move, size in sorted((moved or {}).items()):
                count_one(session, BYTES, move, size)
            return Lease(row.lease_expires_at, row.cancel_requested)

    def succeed(
        self,
        job_id: str,
        attempt: int | None,
        results: Sequence[Mapping[str, Any]],
        warnings: Sequence[ErrorDetail] = (),
    ) -> None:
        """The manifest is written (`results.Results` calls this). attempt None: adopt it, whoever holds the job."""
        with self.database.write() as session:
            sources = None if attempt is None else frozenset({S.running})
            data = [dict(result) for result in results]
            row = self.move(session, job_id, S.succeeded, fence=attempt, sources=sources, results=data)
            count_one(session, BYTES, RESULT_UP, sum(result["size"] for result in data))
            self.finish(session, row, warnings=[*row.warnings, *(w.model_dump(mode="json") for w in warnings)])

    def fail(self, job_id: str, attempt: int, error: JobError, *, expired_only: bool = False) -> None:
        """The attempt failed for a reason that a new attempt would meet again. expired_only: as of `lost`."""
        self._end(job_id, attempt, S.failed, error, expired_only=expired_only)

    def reject(self, job_id: str, attempt: int, error: JobError) -> None:
        """The engine found the scan unusable; `error.details` list every problem."""
        self._end(job_id, attempt, S.rejected, error)

    def canceled(self, job_id: str, attempt: int) -> None:
        """The worker has stopped, with a checkpoint, because the user asked for it."""
        self._end(job_id, attempt, S.canceled, None)

    def preempt(self, job_id: str, attempt: int) -> JobState:
        """The worker must go; the job waits for its next attempt. -> `preempted`, or `canceled` if that was asked."""
        with self.database.write() as session:
            row = self._running(session, job_id, attempt)
            if row.cancel_requested:
                self.finish(session, self.move(session, job_id, S.canceled, fence=attempt))
                return S.canceled
            self.move(session, job_id, S.preempted, fence=attempt, **_released(attempt + 1))
            count_one(session, ATTEMPTS, "preempted")
            return S.preempted

    def lost(self, job_id: str, attempt: int, *, log_tail: str | None = None, expired_only: bool = False) -> JobState:
        """The attempt died. -> `queued` for the next one, `canceled` if that was asked, or `failed` as poison.

        expired_only: only if the lease has run out (StaleAttempt if not), for callers that did not see it die.
        """
        with self.database.write() as session:
            row = self._running(session, job_id, attempt, expired_only=expired_only)
            if log_tail is not None:
                row.log_tail = log_tail
            count_one(session, ATTEMPTS, "lost")
            deaths = 1 if row.reached > row.reached_at_claim else row.deaths + 1
            if row.cancel_requested:
                self.finish(session, self.move(session, job_id, S.canceled, fence=attempt))
                return S.canceled
            if deaths >= POISON_DEATHS:
                error = JobError(
                    code="poison",
                    message=f"{deaths} attempts in a row died without progress (stage "
                    f"{row.progress.get('stage') or 'start'}); most often the worker ran out of memory. "
                    "Try smaller views or a smaller texture, or retry on a larger machine.",
                    log_tail=row.log_tail,
                )
                moved = self.move(session, job_id, S.failed, fence=attempt, deaths=deaths, error=error.model_dump())
                self.finish(session, moved)
                return S.failed
            self.move(session, job_id, S.queued, fence=attempt, deaths=deaths, **_released(attempt + 1))
            return S.queued

    # -- dispatcher and reconciler --------------------------------------------------------------------------------

    def waiting(self, limit: int, memory_bytes: int | None = None, offered: Collection[str] = ()) -> list[WaitingJob]:
        """Jobs to run next, of those that fit a worker of so much memory, as `fair_queue` orders them.

        offered: ids of those that are on their way to a worker.
        """
        gib = None if memory_bytes is None else memory_bytes // GIB
        with self.database.read() as session:
            return next_jobs(session, limit, self.database.now(session), gib, offered, self._gaze)

    def ready(self, limit: int) -> dict[int, int]:
        """How many of the jobs that wait begin as soon as they have workers, by the GiB that they need; of those that
        come first no more than `limit`."""
        with self.database.read() as session:
            found = [job.id for job in next_jobs(session, limit, self.database.now(session))]
            query = select(JobRow.memory_gib, func.count()).where(JobRow.id.in_(found)).group_by(JobRow.memory_gib)
            return {int(gib): int(count) for gib, count in session.execute(query)}

    def paused(self, offered: Collection[str]) -> set[str]:
        """Of the jobs that are on their way to a worker those whose batch was paused."""
        with self.database.read() as session:
            if not (batches := read_holds(session).paused):
                return set()
            query = select(JobRow.id, JobRow.owner, JobRow.batch).where(JobRow.id.in_(list(offered)))
            return {job_id for job_id, *batch in session.execute(query) if tuple(batch) in batches}

    def uploads_of(self, job_ids: Sequence[str]) -> dict[str, str]:
        """The uploads of those of the jobs whose scans were sent, not referred to."""
        with self.database.read() as session:
            query = select(JobRow.id, JobRow.upload_id).where(JobRow.id.in_(job_ids), JobRow.source.is_(None))
            return {row.id: row.upload_id for row in session.execute(query)}

    def any_preempted(self) -> bool:
        """Whether a job waits that had to give its worker back."""
        with self.database.read() as session:
            return session.scalar(select(JobRow.id).where(JobRow.state == S.preempted, KEPT).limit(1)) is not None

    def explain(self, reason: str, *, above: int = -1, up_to: int | None = None) -> None:
        """Tell why jobs wait that need more than `above` and no more than `up_to` bytes of memory (whole GiB).

        A thousand rows at most: where more wait, those that are left are told the next time. What a worker declined
        keeps the reason that it gave.
        """
        pairs = distinct_pairs(WAITS_FOR_A_REASON, JobRow.memory_gib, JobRow.waiting_reason)
        wrong = select(pairs.c.first, pairs.c.second).where(pairs.c.first > above // GIB, pairs.c.second != reason)
        wrong = wrong.where(pairs.c.second.not_like(f"{DECLINED}%"))
        if up_to is not None:
            wrong = wrong.where(pairs.c.first <= up_to // GIB)
        with self.database.read() as session:
            use_order_of_index(session)
            found = session.execute(wrong).all()
        left = EXPLAINED
        for gib, told in found:
            where = and_(WAITS_FOR_A_REASON, JobRow.memory_gib == gib, JobRow.waiting_reason == told)
            with self.database.write() as session:
                now = self.database.now(session)
                # Another server tells them at the same time: what it has locked is left to it.
                some = select(JobRow.id).where(where).limit(left).with_for_update(skip_locked=True)
                ids = session.scalars(some).all()
                values = {"waiting_reason": reason, "version": JobRow.version + 1, "updated_at": now}
                session.execute(update(JobRow).where(JobRow.id.in_(ids)).values(**values))
            if (left := left - len(ids)) == 0:
                return

    def expired(self, limit: int = 100, *, aside: bool = False) -> list[tuple[str, int]]:
        """(job, attempt) whose lease has run out, of jobs that were set aside, or were not."""
        with self.database.read() as session:
            now = self.database.now(session)
            query = select(JobRow.id, JobRow.attempt).where(JobRow.state == S.running, KEPT)
            wanted = not_aside(ADOPT, JobRow.id, now)
            query = query.where(JobRow.lease_expires_at < now, ~wanted if aside else wanted)
            return [(job_id, attempt) for job_id, attempt in session.execute(query.limit(limit))]

    def count_by_state(self) -> dict[str, int]:
        """Jobs that are not deleted."""
        with self.database.read() as session:
            query = select(JobRow.state, func.count()).where(JobRow.deleted_at.is_(None)).group_by(JobRow.state)
            return {state: int(count) for state, count in session.execute(query)}

    # -- user -----------------------------------------------------------------------------------------------------

    def job(self, job_id: str, owner: str | None = None) -> JobRow:
        """The row; RecordNotFound also when it belongs to another owner or was deleted."""
        with self.database.read() as session:
            return self._get(session, job_id, owner)

    def events(self, job_id: str, after_version: int) -> list[EventRow]:
        """Recorded changes of state and stage, oldest first."""
        with self.database.read() as session:
            query = select(EventRow).where(EventRow.job_id == job_id, EventRow.version > after_version)
            return list(session.scalars(query.order_by(EventRow.version)))

    def cancel(self, job_id: str, owner: str | None = None) -> JobRow:
        """A running job is asked to end, any other ends at once. Canceling a canceled job changes nothing."""
        with self.database.write() as session:
            row = self._get(session, job_id, owner, lock=True)
            if row.state == S.canceled or (row.state == S.running and row.cancel_requested):
                return row
            if row.state == S.running:
                row.cancel_requested = True
                row.version, row.updated_at = row.version + 1, self.database.now(session)
                return row
            begun = row.attempt - 1 if row.state in WAITING else row.attempt
            return self.finish(session, self.move(session, job_id, S.canceled, attempt=begun))

    def retry(self, job_id: str, owner: str | None = None, *, max_active_jobs: int | None = None) -> JobRow:
        """A failed or canceled job goes on from its checkpoint with a new attempt, or with its check. QuotaExceeded."""
        with self.database.write() as session:
            row = self._get(session, job_id, owner, lock=True)
            check_active_jobs(session, row.owner, max_active_jobs)
            ended = {"cancel_requested": False, "error": None, "finished_at": None, "expires_at": None, "deaths": 0}
            to = S.checking if row.checked_at is None else S.queued
            following = _released(row.attempt + (to is S.queued))
            return self.move(session, job_id, to, sources=RETRYABLE, waiting_reason="", **ended, **following)

    def delete(self, job_id: str, owner: str | None = None) -> None:
        """Hide an ended job; its blobs follow (`purged`)."""
        with self.database.write() as session:
            row = self._get(session, job_id, owner, lock=True)
            if row.state not in TERMINAL:
                raise IllegalTransition(f"job {job_id} is {row.state}: cancel it before deleting it")
            row.deleted_at = row.updated_at = self.database.now(session)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _end(
        self, job_id: str, attempt: int, to: JobState, error: JobError | None, *, expired_only: bool = False
    ) -> None:
        with self.database.write() as session:
            if expired_only:
                self._running(session, job_id, attempt, expired_only=True)
            data = None if error is None else error.model_dump(mode="json")
            self.finish(
                session, self.move(session, job_id, to, sources=frozenset({S.running}), fence=attempt, error=data)
            )


def _waiting_since(session: Session, row: JobRow) -> float | None:
    """When it began to wait for the attempt that was just claimed: the change of state before that one."""
    before = select(EventRow.data).where(EventRow.job_id == row.id, EventRow.version < row.version)
    data = session.scalar(before.order_by(EventRow.version.desc()).limit(1)) or {}
    return data.get("at")


def _released(next_attempt: int) -> dict[str, Any]:
    return {"attempt": next_attempt, "worker": None, "lease_expires_at": None}
