"""`advtex-worker`: takes jobs from the queue until it is told to go, one at a time or as many as its GPUs can have.

Settings come from `ADVTEX_*`. Exit codes: 0 after SIGTERM or SIGINT, and when it has had its jobs or nothing to do; 75
when its time was up, or its machine is taken away: start it again; 1 if it cannot work; 2 for wrong arguments.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from types import FrameType
from typing import Any

import structlog
from pydantic import ValidationError
from redis.exceptions import RedisError
from rq import Worker
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from sqlalchemy.exc import SQLAlchemyError

from advtex_scan.version import product_version
from advtex_store.database import read_schema
from advtex_store.errors import SchemaRefused
from advtex_store.fleet import Fleet, WorkerReport
from advtex_store.logs import configure_logs
from advtex_store.process_ends import die_with_parent
from advtex_store.queue import JobQueue, attempt_of, class_of, connect_redis, queue_name
from advtex_store.secrecy import hide_environment
from advtex_worker.gpu_readings import GpuWatch
from advtex_worker.leaving import STOP_SIGNALS, Departure, Reason, Stay, add_arguments, parent_of, read_stay
from advtex_worker.settings import WorkerSettings
from advtex_worker.slots import Slot, find_slots, hold, settings_of, supervise
from advtex_worker.tasks import Host, serve_as

RECONNECT_SECONDS = 2
HEARTBEAT_SECONDS = 5  # between signs of life in Redis
RQ_WAIT_MARGIN = 15  # RQ waits so much shorter for a job than its worker's time to live
SCHEMA_SECONDS = 2.0  # between looks at a schema that is not ready

log = structlog.get_logger()


class JobWorker(Worker):
    """RQ's worker with five changes: it hands stop signals on to its work-horse instead of waiting for it or killing
    it, its work-horse does not outlive it, losing Redis in the middle of a job changes nothing, it announces itself
    with what it can take, and it goes when its stay is over.
    """

    max_connection_wait_time = RECONNECT_SECONDS

    def __init__(
        self, host: Host, connection: Any, departure: Departure, gib: int, gpu: GpuWatch | None = None
    ) -> None:
        self._host = host
        self._departure = departure
        self._gib = gib
        self._parent_pid = os.getpid()
        self._presence = JobQueue(connection)
        self._fleet = Fleet(self._presence)
        self._gpu = gpu
        self._busy = False
        self._report = WorkerReport(host=socket.gethostname(), release=product_version())
        self._leaves = False
        self._known_as = f"{socket.gethostname()}-{self._parent_pid}"
        super().__init__(
            [queue_name(gib)],
            connection=connection,
            serializer=JSONSerializer,
            worker_ttl=HEARTBEAT_SECONDS + RQ_WAIT_MARGIN,
            job_monitoring_interval=HEARTBEAT_SECONDS,
        )

    def register_birth(self) -> None:
        super().register_birth()  # type: ignore[no-untyped-call]
        self._announce()

    def _announce(self, pipeline: Any = None) -> None:
        self._presence.announce(self._known_as, self._gib, pipeline, busy=self._busy)
        reading = None if self._gpu is None else self._gpu.newest
        self._fleet.tell(self._known_as, self._report.model_copy(update={"gpu": reading}), pipeline)

    def heartbeat(self, timeout: int | None = None, pipeline: Any = None) -> None:
        super().heartbeat(timeout, pipeline)
        self._announce(pipeline)

    def work(self, *args: Any, **named: Any) -> bool:
        """RQ's; but it leaves a thread that listens for commands, and its connection, behind whenever it cannot take
        leave of Redis."""
        try:
            return bool(super().work(*args, **named))
        finally:
            if self.pubsub_thread is not None:
                self.pubsub_thread.stop()
            self.connection.connection_pool.disconnect()  # wakes it

    def _pubsub_exception_handler(self, exc: Exception, pubsub: Any, pubsub_thread: Any) -> None:
        """RQ's; but a listener whose connection was closed while it read just ends, whatever the read said."""
        if self._leaves:
            pubsub_thread.stop()
        else:
            super()._pubsub_exception_handler(exc, pubsub, pubsub_thread)

    def register_death(self) -> None:
        self._leaves = True
        self._presence.depart(self._known_as)
        super().register_death()  # type: ignore[no-untyped-call]

    def _install_signal_handlers(self) -> None:
        for number in STOP_SIGNALS:
            signal.signal(number, self.request_stop)

    def request_stop(self, signum: int, _frame: FrameType | None) -> None:
        """The horse checkpoints and gives its job back; without one, the worker ends at once. May come repeatedly."""
        self._stop_requested = True
        self._departure.begin_on_signal(signum)
        if self.horse_pid:
            os.kill(self.horse_pid, signal.SIGTERM)
        else:
            raise StopRequested

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:
        """None, on which RQ ends, once all slots have been idle for as long as they may. It leaves between two waits
        for a job, so that it never takes one with it."""
        with suppress(RedisError):  # RQ waits for it
            self._presence.prefer_near(socket.gethostname(), self._gib)
        while True:
            found = super().dequeue_job_and_maintain_ttl(timeout, max_idle_time)
            if found is not None:
                return found
            if not self._is_sibling_busy():
                self._departure.begin(Reason.idle)
                return None

    def _is_sibling_busy(self) -> bool:
        """Whether a worker of the same parent has a job: another slot, or another task of a batch system's step. They
        hold the machine together, so they leave it together."""
        names = self._presence.busy_workers(socket.gethostname())
        return any(parent_of(int(name.rpartition("-")[2])) == os.getppid() for name in names)

    def execute_job(self, job: Any, queue: Any) -> None:
        """The work-horse inherits the context: its lines and RQ's own name the job in both processes."""
        job_id, attempt = attempt_of(job.id)
        with structlog.contextvars.bound_contextvars(job=job_id, attempt=attempt):
            self._tell(busy=True, job=job_id, attempt=attempt, since=time.time())
            try:
                super().execute_job(job, queue)
            finally:
                self._tell(busy=False, job="", attempt=0, since=None)
        self._departure.count_job()
        self._stop_requested = self._departure.reason is not None  # RQ looks before it takes another one

    def _tell(self, *, busy: bool, **attempt: object) -> None:
        """At once: until the next sign of life the dispatcher would count on a worker that has a job."""
        self._busy = busy
        self._report = self._report.model_copy(update=attempt)
        with suppress(RedisError):
            self._announce()

    def fork_work_horse(self, job: Any, queue: Any) -> None:
        """Signals wait until both processes know which one they are."""
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
        try:
            super().fork_work_horse(job, queue)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)

    def setup_work_horse_signals(self) -> None:
        # For the runner too and all that it starts: some send these to every process, and the worker hears them.
        for number in (signal.SIGINT, signal.SIGUSR1):
            signal.signal(number, signal.SIG_IGN)
        self._host.stop_signal.install()
        die_with_parent(self._parent_pid, signal.SIGTERM)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
        serve_as(replace(self._host, gib=self._gib))

    def maintain_heartbeats(self, job: Any) -> None:
        try:
            super().maintain_heartbeats(job)
        except RedisError as error:
            log.warning("Redis is away; the running job is not affected", error=str(error))

    def set_current_job_working_time(self, current_job_working_time: float, pipeline: Any = None) -> None:
        try:
            super().set_current_job_working_time(current_job_working_time, pipeline)
        except RedisError as error:
            log.warning("Redis is away; the running job is not affected", error=str(error))


def serve(host: Host, command: Sequence[str], stay: Stay) -> int:
    """Serve the queue with all slots until a signal comes or the stay is over. -> the exit code. SchemaRefused.

    A single slot is served here; of several each gets a process, started by `command`, and so does one that has to be
    watched from outside.
    """
    departure = Departure(stay, host.settings.grace_seconds)
    departure.raise_on_signals()
    try:
        wait_for_schema(host.settings.database, departure.wait)
        slots = find_slots(host.settings)
        if len(slots) > 1 or stay.is_watched:
            log.info("worker begins slots", slots=len(slots))
            supervise([*command, *stay.slot_arguments()], slots, host.settings, departure)
        else:
            work(replace(host, settings=settings_of(slots[0], host.settings, 1)), slots[0], departure)
    except StopRequested:
        pass
    log.info("worker ends", reason=None if departure.reason is None else departure.reason.words)
    return departure.exit_code


def wait_for_schema(url: str, wait: Callable[[float], object]) -> None:
    """Until the database can be reached and has what this release needs: its servers bring it up to date when they
    start. SchemaRefused where waiting does not help."""
    told = ""
    while True:
        try:
            schema = read_schema(url)
        except SQLAlchemyError as error:
            reason = f"the database does not answer: {str(error).partition(chr(10))[0]}"
        else:
            schema.check()
            if schema.ahead:
                log.warning("a newer release has brought the schema up to date", schema=schema.revision)
            if schema.behind is None:
                return
            reason = schema.behind
        if reason != told:
            log.warning("worker takes no jobs yet", reason=reason)
            told = reason
        wait(SCHEMA_SECONDS)


def work(host: Host, slot: Slot, departure: Departure) -> None:
    """Serve the queue until it is time to go; a Redis that is away is waited for, and so is a slot of a GPU.
    StopRequested, where a signal comes between two connections."""
    gib = class_of(slot.memory_bytes)
    _lock = hold(slot, host.settings.jobs_per_gpu, departure.wait)
    log.info("worker takes jobs", memory_gib=gib, gpu=slot.gpu)
    gpu = GpuWatch(slot.gpu)
    while departure.reason is None:
        try:
            worker = JobWorker(host, connect_redis(host.settings), departure, gib, gpu)
            worker.work(logging_level="WARNING", max_idle_time=departure.stay.idle_seconds)
            if departure.reason is None:
                log.warning("the connection to Redis broke; connecting again")
        except RedisError as error:
            if departure.reason is None:  # else the signal came in the middle of a command
                log.warning("Redis cannot be reached; trying again", error=str(error))
        departure.raise_on_signals()
        departure.wait(RECONNECT_SECONDS)


def argument_parser() -> argparse.ArgumentParser:
    """Of the command line."""
    parser = argparse.ArgumentParser(prog="advtex-worker", description=__doc__)
    parser.add_argument("--version", action="version", version=f"advtex-worker {product_version()}")
    add_arguments(parser)
    return parser


def main() -> None:
    stay = read_stay(argument_parser().parse_args())
    try:
        settings = WorkerSettings()
    except ValidationError as error:
        sys.exit(f"advtex-worker: the configuration is wrong: {error}")
    configure_logs(logging.getLevelNamesMapping()[settings.log_level])
    if (reason := hide_environment()) is not None:
        log.warning("runners could read this process's environment, passwords included", reason=reason)
    log.info("worker begins", device=settings.device, threads=settings.threads)
    try:
        code = serve(Host(settings), [sys.executable, "-m", "advtex_worker.main"], stay)
    except SchemaRefused as refused:
        sys.exit(f"advtex-worker: {refused}")
    sys.exit(code)


if __name__ == "__main__":
    main()
