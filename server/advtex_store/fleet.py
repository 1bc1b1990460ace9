"""What the living workers do, in Redis, for those who watch: nothing depends on it, and older workers tell less."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from advtex_store.queue import BUSY, PRESENCE, PRESENCE_SECONDS, JobQueue, text_of

REPORT = "advtex:report:"


class _Told(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class GpuReading(_Told):
    """One GPU: `utilization` is the share of time in which it computed, from 0 to 1; None where nothing tells it."""

    uuid: str
    memory_used_bytes: int
    memory_bytes: int
    utilization: float | None = None


class WorkerReport(_Told):
    """What a worker tells beyond that it lives: its host, release and GPU, and the attempt that it has (`job`, if any),
    since when by its own clock."""

    host: str = ""
    release: str = ""
    gpu: GpuReading | None = None
    job: str = ""
    attempt: int = 0
    since: float | None = None


class LivingWorker(_Told):
    """A worker on which jobs may use `memory_gib` GiB."""

    name: str
    memory_gib: int
    busy: bool
    report: WorkerReport


class Fleet:
    """The workers that announced themselves in the last seconds. Every method raises `redis.RedisError`."""

    def __init__(self, queue: JobQueue) -> None:
        self.queue = queue

    def tell(self, name: str, report: WorkerReport, connection: Any = None) -> None:
        """Called by the worker with each announcement; `connection` may be a pipeline."""
        (connection or self.queue.redis).set(
            REPORT + name, report.model_dump_json(exclude_defaults=True), ex=PRESENCE_SECONDS
        )

    def workers(self) -> list[LivingWorker]:
        """All of them, by class and name."""
        names = self.queue.workers()
        if not names:
            return []
        told = self.queue.redis.mget([PRESENCE + name for name in names] + [REPORT + name for name in names])
        found = [
            LivingWorker(
                name=name,
                memory_gib=int(text_of(presence).removesuffix(BUSY)),
                busy=text_of(presence).endswith(BUSY),
                report=_report(report),
            )
            for name, presence, report in zip(names, told[: len(names)], told[len(names) :], strict=True)
            if presence is not None
        ]
        return sorted(found, key=lambda worker: (worker.memory_gib, worker.name))


def _report(told: bytes | str | None) -> WorkerReport:
    try:
        return WorkerReport.model_validate_json(told or b"{}")
    except ValidationError:  # of another release
        return WorkerReport()
