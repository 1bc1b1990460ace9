"""One attempt of one job, from the claim to the commit. Nothing here imports torch."""

from __future__ import annotations

import math
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import IO

import structlog

from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import JobError
from advtex_store import keys
from advtex_store.counters import CHECKPOINT_DOWN, CHECKPOINT_UP, SCAN_DOWN
from advtex_store.errors import BlobNotFound, ReferenceRefused, ResultsUnreadable, ScanDamaged, StaleAttempt
from advtex_store.process_ends import how_it_ended
from advtex_store.records import Claim
from advtex_store.store import Store
from advtex_worker.ahead import Ahead
from advtex_worker.checkpoints import CheckpointUploader, restore
from advtex_worker.child import Child
from advtex_worker.download import download_scan
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
from advtex_worker.patience import Interrupted, Patience, Refused
from advtex_worker.progress import ProgressTracker
from advtex_worker.scan_cache import ScanCache, cache_name
from advtex_worker.settings import WorkerSettings
from advtex_worker.tracing import NOT_TRACED, AttemptTrace
from advtex_worker.workspace import workspace_of

KILL_SECONDS = 1.0  # after a cancel: a runner whose interpreter is held by native code does not hear it
RECORD_SECONDS = 1.2  # after a cancel: what is not in the storage by then stays out of it

log = structlog.get_logger()


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
        fetched = partial(self._keeper.moved, SCAN_DOWN)
        self._ahead = None if gib is None or self._cache.limit_bytes == 0 else Ahead(store, self._cache, gib, fetched)
        self._child: Child | None = None
        self._killers: list[threading.Timer] = []
        self._canceled_at = math.inf
        self._warnings: tuple[ErrorDetail, ...] = ()
        self._log = log.bind(job=claim.job_id, attempt=claim.attempt)
        self._patience = Patience(self._keeper, self._cache, settings, lambda: self._canceled, self._log)

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
            if self._patience.persist(lambda: self._store.results.adopt(self._job_id)):
                return
            with self._stack:
                self._patience.persist(lambda: self._stack.enter_context(self._space.made()))
                self._run()
        except Interrupted:
            self._give_back()
        except ResultsUnreadable as damage:
            told = damage  # the name of an exception ends with its clause
            self._patience.record(lambda: self._store.results.end_unread(self._job_id, self._number, told))
        except Refused as refused:
            error = JobError(code="storage_refused", message=str(refused), log_tail=self._log_tail())
            self._patience.record(lambda: self._store.records.fail(self._job_id, self._number, error))

    def _run(self) -> None:
        try:
            self._patience.transfer(self._fetch_scan)
        except (BlobNotFound, ReferenceRefused) as missing:
            message = "the scan is no longer stored; submit it again"
            error = JobError(code="scan_missing", message=str(missing) if self._claim.source else message)
            self._patience.record(lambda: self._store.records.fail(self._job_id, self._number, error))
            return
        except ScanDamaged as damaged:
            damage = JobError(code="scan_damaged", message=str(damaged))
            self._patience.persist(lambda: self._store.uploads.distrust(self._claim.upload_id))
            self._patience.record(lambda: self._store.records.fail(self._job_id, self._number, damage))
            return
        if self._ahead is not None:
            self._ahead.start()
            self._stack.callback(self._ahead.stop)
        base = self._patience.transfer(lambda: restore(self._store.blobs, self._job_id, self._number, self._space.work))
        self._keeper.moved(CHECKPOINT_DOWN, sum(file.size for file in base.files.values()))
        self._check_ending()
        self._warnings = base.warnings
        self._log.info("attempt begins", resumed_files=len(base.files))
        saved = partial(self._store.live_progress.saved, self._job_id, self._number)
        saved()
        sent = partial(self._keeper.moved, CHECKPOINT_UP)
        uploader = CheckpointUploader(
            self._store.blobs, self._job_id, self._number, base, self._keeper.held, saved, sent
        )
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
            copied = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())  # none of a file:// URL
            self._keeper.moved(SCAN_DOWN, copied)
        elif self._cache.limit_bytes > 0:
            name = cache_name(self._claim.upload_id)
            self._scan = self._stack.enter_context(self._cache.held(name, self._download, self._check_ending))
        else:
            with self._scan.open("wb") as file:
                self._download(file)

    def _download(self, file: IO[bytes]) -> None:
        def arrived(size: int) -> None:
            self._keeper.moved(SCAN_DOWN, size)
            self._check_ending()

        download_scan(self._store, self._claim.upload_id, file, arrived)

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
                    self._keeper.paused = self._patience.no_room(f"{self._settings.workspaces}")
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
            self._patience.transfer(
                lambda: self._store.results.commit(
                    job_id, number, self._space.results(), self._warnings, closing=self._keeper.closing
                )
            )
            self._keeper.stop()  # of a job that has ended there is no lease to be lost
            with suppress(Exception):  # they are only worth their space now; deleting the job removes them too
                self._store.blobs.delete_prefix(keys.checkpoints_prefix(job_id))
                self._store.blobs.delete_prefix(keys.live_prefix(job_id))
        elif isinstance(ended, FailedEvent) and ended.code == "invalid_scan":
            rejection = JobError(code=ended.code, message=ended.message, details=ended.details)
            self._patience.record(lambda: records.reject(job_id, number, rejection))
        elif isinstance(ended, FailedEvent):
            error = JobError(code=ended.code, message=ended.message, details=ended.details, log_tail=tail)
            self._patience.record(lambda: records.fail(job_id, number, error))
        elif self._keeper.ending or isinstance(ended, StoppedEvent):
            self._give_back()
        else:
            told = f"{tail.rstrip()}\n{sentence}\n".lstrip()
            state = self._patience.record(lambda: records.lost(job_id, number, log_tail=told))
            self._log.warning("runner died", reason=sentence, job_is=state)

    def _give_back(self) -> None:
        """After a cancel or a SIGTERM, also one that only the runner got, with whatever checkpoint there is."""
        records, job_id, number = self._store.records, self._job_id, self._number
        if self._keeper.ending is Ending.cancel:
            self._patience.record(lambda: records.canceled(job_id, number))
        elif self._keeper.ending is not Ending.lost:
            self._patience.record(lambda: records.preempt(job_id, number))

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

    def _log_tail(self) -> str:
        return self._child.log_tail() if self._child else ""
