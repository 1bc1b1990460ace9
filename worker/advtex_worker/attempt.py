"""One attempt of one job, from the claim to the commit. Nothing here imports torch."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import ExitStack, suppress
from functools import partial
from typing import IO, TypeVar

import structlog
from sqlalchemy.exc import SQLAlchemyError

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import JobError
from advtex_store import keys
from advtex_store.errors import (
    BlobNotFound,
    BlobsRefused,
    NoSpace,
    ReferenceRefused,
    ReferenceUnreadable,
    StaleAttempt,
    StoreError,
)
from advtex_store.files import translated
from advtex_store.process_ends import how_it_ended
from advtex_store.records import Claim
from advtex_store.store import Store
from advtex_worker.ahead import Ahead
from advtex_worker.checkpoints import CheckpointUploader, restore
from advtex_worker.child import Child
from advtex_worker.events import (
    CheckpointEvent,
    DiskFullEvent,
    FailedEvent,
    FinishedEvent,
    LiveEvent,
    NoteEvent,
    ProgressEvent,
    Request,
    StageEvent,
    StoppedEvent,
    WarningEvent,
)
from advtex_worker.lease import Ending, LeaseKeeper
from advtex_worker.live import LivePoster
from advtex_worker.progress import ProgressTracker
from advtex_worker.scan_cache import ScanCache, cache_name
from advtex_worker.settings import WorkerSettings
from advtex_worker.tracing import NOT_TRACED, AttemptTrace
from advtex_worker.workspace import workspace_of

RETRY_SECONDS = 5.0
KILL_SECONDS = 1.0  # after a cancel: a runner whose interpreter is held by native code does not hear it
POLL_SECONDS = 0.05
REASON_LENGTH = 120
RECORD_SECONDS = 1.2  # after a cancel: what is not in the storage by then stays out of it

T = TypeVar("T")
log = structlog.get_logger()


class Interrupted(Exception):
    """The run has to end (`LeaseKeeper.ending` says why) while something waits for storage."""


class Refused(Exception):
    """The storage has refused what the attempt needs for too long."""


class Attempt:
    """Carries a claimed job to one of its ends. `stop` may be called at any time, also from a signal handler.

    gib: the class of its worker; None where it belongs to none, and nothing is downloaded ahead.
    """

    def __init__(
        self,
        store: Store,
        settings: WorkerSettings,
        engine: str,
        claim: Claim,
        gib: int | None = None,
        trace: AttemptTrace = NOT_TRACED,
    ) -> None:
        self._store = store
        self._trace = trace
        self._settings = settings
        self._engine = engine
        self._job_id = claim.job_id
        self._number = claim.attempt
        self._claim = claim
        self._space = workspace_of(settings.workspaces, claim.job_id, claim.attempt)
        self._scan = self._space.scan
        self._cache = ScanCache(settings.scan_cache, settings.cached_bytes)
        self._ahead = None if gib is None or self._cache.limit_bytes == 0 else Ahead(store, self._cache, gib)
        self._stack = ExitStack()  # of what is held for as long as the attempt lasts
        self._keeper = LeaseKeeper(
            store.records,
            claim.job_id,
            claim.attempt,
            interval=settings.heartbeat_seconds,
            on_ending=self._on_ending,
            log_tail=self._log_tail,
            show=partial(store.live_progress.tell, claim.job_id, claim.attempt),
        )
        self._child: Child | None = None
        self._killers: list[threading.Timer] = []
        self._canceled_at = math.inf
        self._warnings: tuple[ErrorDetail, ...] = ()
        self._log = log.bind(job=claim.job_id, attempt=claim.attempt)

    def stop(self) -> None:
        """The worker must go: checkpoint, and leave the job to the next attempt."""
        threading.Thread(target=self._keeper.end, args=(Ending.preempt,), daemon=True).start()

    def carry(self) -> None:
        """Do the work and record how it ended. A lost lease ends it without a word: the job is another attempt's."""
        self._keeper.start()
        try:
            self._run_or_give_back()
        except StaleAttempt as error:
            self._log.warning("attempt is stale", reason=str(error))
        except Interrupted:
            self._log.warning("the lease was lost before the end could be recorded")
        finally:
            self._keeper.stop()

    def _run_or_give_back(self) -> None:
        try:
            if self._persist(lambda: self._store.results.adopt(self._job_id)):
                return
            with self._stack:
                self._persist(lambda: self._stack.enter_context(self._space.made()))
                self._run()
        except Interrupted:
            self._give_back()
        except Refused as refused:
            error = JobError(code="storage_refused", message=str(refused), log_tail=self._log_tail())
            self._record(lambda: self._store.records.fail(self._job_id, self._number, error))

    def _run(self) -> None:
        try:
            self._transfer(self._fetch_scan)
        except (BlobNotFound, ReferenceRefused) as missing:
            message = "the scan is no longer stored; submit it again"
            error = JobError(code="scan_missing", message=str(missing) if self._claim.source else message)
            self._record(lambda: self._store.records.fail(self._job_id, self._number, error))
            return
        if self._ahead is not None:
            self._ahead.start()
            self._stack.callback(self._ahead.stop)
        base = self._transfer(lambda: restore(self._store.blobs, self._job_id, self._number, self._space.work))
        self._check_ending()
        self._warnings = base.warnings
        self._log.info("attempt begins", resumed_files=len(base.files))
        saved = partial(self._store.live_progress.saved, self._job_id, self._number)
        saved()
        uploader = CheckpointUploader(self._store.blobs, self._job_id, self._number, base, self._keeper.held, saved)
        poster = LivePoster(self._store.live, self._job_id, self._number, self._keeper.held)
        ended: FinishedEvent | FailedEvent | StoppedEvent | None = None
        try:
            with self._spawn(resume=bool(base.files)) as child:
                self._child = child
                ended = self._listen(child, uploader, poster)
        finally:
            poster.stop()
            for killer in self._killers:
                killer.cancel()
            if self._keeper.ending is Ending.lost or isinstance(ended, FinishedEvent):
                uploader.abandon(self._out_of_time)
            else:
                uploader.finish(self._out_of_time)
        self._conclude(ended, child.returncode)

    def _fetch_scan(self) -> None:
        """In pieces, so that a cancel does not wait for gigabytes."""
        if self._claim.source is not None:
            folder = self._space.root / "source"
            self._scan = self._store.references.fetch(self._claim.source, folder, self._check_ending)
        elif self._cache.limit_bytes > 0:
            name = cache_name(self._claim.upload_id)
            self._scan = self._stack.enter_context(self._cache.held(name, self._download, self._check_ending))
        else:
            with self._scan.open("wb") as file:
                self._download(file)

    def _download(self, file: IO[bytes]) -> None:
        for chunk in self._store.blobs.stream(self._claim.scan_key):
            file.write(chunk)
            self._check_ending()

    def _check_ending(self) -> None:
        if self._keeper.ending:
            raise Interrupted

    def _spawn(self, resume: bool) -> Child:
        space = self._space
        request = Request(
            engine=self._engine,
            scan=self._scan,
            out=space.out,
            work=space.work,
            snapshots=space.snapshots,
            resume=resume,
            options=self._claim.options,
            # A runner of a slot sees the slot's GPU alone.
            device=self._settings.device if self._settings.gpu is None else "cuda",
            jobs_per_gpu=self._settings.jobs_per_gpu,
            memory_bytes=self._settings.memory_bytes,
        )
        child = Child(request, space.log, self._settings.threads, self._settings.gpu)
        self._log.info("runner started", pid=child.pid)
        return child

    def _listen(
        self, child: Child, uploader: CheckpointUploader, poster: LivePoster
    ) -> FinishedEvent | FailedEvent | StoppedEvent | None:
        """Everything the runner says, in order. -> how it said that it ended, None if it died."""
        if self._keeper.ending:  # asked before there was anybody to ask
            self._on_ending(Ending.cancel if self._canceled else self._keeper.ending)
        tracker = ProgressTracker(self._claim.progress)
        for event in child.events():
            match event:
                case StageEvent():
                    tracker.stage(event)
                    self._trace.stage(event)
                case ProgressEvent():
                    tracker.progress(event)
                case WarningEvent():
                    if event.problem not in self._warnings:  # a stage that is done again warns again
                        self._warnings += (event.problem,)
                case NoteEvent():
                    tracker.note(event)
                case LiveEvent():
                    poster.post(event.record)
                case CheckpointEvent():
                    uploader.add(event.files, self._warnings)
                case DiskFullEvent():
                    self._cache.shrink(0)
                    self._keeper.paused = self._no_room(f"{self._settings.workspaces}")
                    continue
                case _:
                    return event
            self._keeper.paused = ""
            self._keeper.report(tracker.view, tracker.reached)
        return None

    def _conclude(self, ended: FinishedEvent | FailedEvent | StoppedEvent | None, code: int) -> None:
        records, job_id, number = self._store.records, self._job_id, self._number
        sentence = f"the engine's process {how_it_ended(code)}"
        self._log.info("runner ended", ending=ended.kind if ended else sentence, asked=self._keeper.ending)
        if self._keeper.ending is Ending.lost:
            return
        self._keeper.beat()  # the newest progress is recorded before the end
        tail = self._log_tail()
        if isinstance(ended, FinishedEvent):
            self._transfer(lambda: self._store.results.commit(job_id, number, self._space.results(), self._warnings))
            self._keeper.stop()  # of a job that has ended there is no lease to be lost
            with suppress(Exception):  # they are only worth their space now; deleting the job removes them too
                self._store.blobs.delete_prefix(keys.checkpoints_prefix(job_id))
                self._store.blobs.delete_prefix(keys.live_prefix(job_id))
        elif isinstance(ended, FailedEvent) and ended.code == "invalid_scan":
            rejection = JobError(code=ended.code, message=ended.message, details=ended.details)
            self._record(lambda: records.reject(job_id, number, rejection))
        elif isinstance(ended, FailedEvent):
            error = JobError(code=ended.code, message=ended.message, details=ended.details, log_tail=tail)
            self._record(lambda: records.fail(job_id, number, error))
        elif self._keeper.ending or isinstance(ended, StoppedEvent):
            self._give_back()
        else:
            told = f"{tail.rstrip()}\n{sentence}\n".lstrip()
            state = self._record(lambda: records.lost(job_id, number, log_tail=told))
            self._log.warning("runner died", reason=sentence, job_is=state)

    def _give_back(self) -> None:
        """After a cancel or a SIGTERM, also one that only the runner got, with whatever checkpoint there is."""
        records, job_id, number = self._store.records, self._job_id, self._number
        if self._keeper.ending is Ending.cancel:
            self._record(lambda: records.canceled(job_id, number))
        elif self._keeper.ending is not Ending.lost:
            self._record(lambda: records.preempt(job_id, number))

    def _on_ending(self, ending: Ending) -> None:
        if ending is Ending.cancel:
            self._canceled_at = min(self._canceled_at, time.monotonic())
        child = self._child
        if child is None:
            return
        if ending is Ending.lost:
            child.kill()
        elif ending is Ending.cancel:
            child.cancel()
            self._kill_after(KILL_SECONDS, child)
        else:
            child.ask_to_stop()
            self._kill_after(self._settings.grace_seconds, child)

    def _kill_after(self, seconds: float, child: Child) -> None:
        killer = threading.Timer(seconds, child.kill)
        killer.daemon = True
        killer.start()
        self._killers.append(killer)

    @property
    def _canceled(self) -> bool:
        """Also after a SIGTERM, which stays the ending."""
        return self._canceled_at < math.inf

    def _out_of_time(self) -> bool:
        return time.monotonic() - self._canceled_at >= RECORD_SECONDS

    def _why_paused(self, error: Exception) -> str:
        if _is_disk_full(error):
            return self._no_room(f"{self._settings.workspaces} or the storage")
        reason = str(error)[:REASON_LENGTH]  # the row's column is short
        return f"its worker {socket.gethostname()[:64]} cannot use the storage ({reason}); it goes on when it can"

    def _no_room(self, place: str) -> str:
        return f"the disk of its worker {socket.gethostname()} is full ({place}); it goes on when there is room"

    def _log_tail(self) -> str:
        return self._child.log_tail() if self._child else ""

    def _record(self, action: Callable[[], T]) -> T:
        """Tell the rows how it ended, again until they answer or the lease is lost (Interrupted)."""
        while self._keeper.ending is not Ending.lost:
            try:
                return action()
            except SQLAlchemyError as error:
                self._log.warning("the end cannot be recorded, trying again", error=str(error))
            time.sleep(0.5)
        raise Interrupted

    def _transfer(self, action: Callable[[], T]) -> T:
        """`_persist` for what may take long. A cancel leaves it behind: nothing that it still writes counts."""
        return self._persist(lambda: self._unless_canceled(action))

    def _unless_canceled(self, action: Callable[[], T]) -> T:
        future: Future[T] = Future()

        def act() -> None:
            try:
                future.set_result(action())
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=act, name="transfer", daemon=True).start()
        while not wait([future], timeout=POLL_SECONDS).done:
            if self._canceled:
                raise Interrupted
        return future.result()

    def _persist(self, action: Callable[[], T]) -> T:
        """Try until the storage plays along: a full disk or an unreachable bucket pauses the work and loses nothing.

        Refused: it was no outage, but a refusal that did not change for `refused_seconds`.
        """
        refused_at = math.inf
        while True:
            try:
                done = action()
            except (OSError, StoreError, SQLAlchemyError) as error:
                if _is_answer(error):
                    raise
                if _is_disk_full(error):
                    self._cache.shrink(0)
                self._keeper.paused = self._why_paused(error)
                self._log.warning("storage is in trouble, trying again", error=f"{type(error).__name__}: {error}")
                refused_at = min(refused_at, time.monotonic()) if _is_refusal(error) else math.inf
                if time.monotonic() - refused_at >= self._settings.refused_seconds:
                    host, minutes = socket.gethostname(), self._settings.refused_seconds / 60
                    raise Refused(f"the worker {host} was refused for {minutes:.0f} min: {error}") from error
            else:
                self._keeper.paused = ""
                return done
            for _ in range(int(RETRY_SECONDS / 0.5)):
                if self._keeper.ending:
                    raise Interrupted
                time.sleep(0.5)


def _is_answer(error: Exception) -> bool:
    """Errors that say how things are: no other try would say otherwise."""
    if isinstance(error, ReferenceUnreadable):  # may be mended while the job waits
        return False
    return isinstance(error, StaleAttempt | BlobNotFound | ReferenceRefused)


def _is_refusal(error: Exception) -> bool:
    """Errors that stay until somebody mends rights or settings, unlike an outage or a full disk."""
    lasting = PermissionError | FileNotFoundError | NotADirectoryError | BlobsRefused | ReferenceUnreadable
    return isinstance(error, lasting)


def _is_disk_full(error: Exception) -> bool:
    return isinstance(translated(error) if isinstance(error, OSError) else error, NoSpace)
