"""A fleet for people to look at: workers that only announce themselves, owners with jobs that wait, and failures."""

from __future__ import annotations

from advtex_contract.jobs import JobError, JobState, Progress
from advtex_store.fleet import GpuReading, WorkerReport
from advtex_store.ids import new_id
from advtex_store.models import JobRow, UploadRow
from advtex_store.store import Store

GIB = 1 << 30
OWNERS = ("tests", "institute of robotics", "<img src=x onerror=alert(1)>")
FAILURES = (
    JobError(code="poison", message="3 attempts in a row died without progress (stage optimization)"),
    JobError(code="engine_error", message="the engine failed: ValueError: the widget is not a gadget"),
)


def gather(store: Store, jobs: int = 24) -> None:
    """Jobs that wait need more memory than any worker has that takes jobs."""
    for number in range(jobs):
        owner = OWNERS[number % len(OWNERS)]
        job = _waiting(store, owner, f"scan {number}", (900 + number % 2) * GIB)
        name, part = f"gpu-node-{number % 3}-{1000 + number}", number % 4
        if part == 0:
            continue
        store.records.claim(job, 1, name, lease_seconds=3600)
        if part == 1:
            step = 1000 * number
            progress = Progress(
                stage="optimization", step=step, steps=50_000, steps_per_second=9, eta_seconds=90 * number
            )
            store.records.heartbeat(job, 1, progress, lease_seconds=3600)
            used = GpuReading(
                uuid=f"GPU-{number}", memory_used_bytes=number * GIB, memory_bytes=80 * GIB, utilization=0.9
            )
            store.queue.announce(name, 80, busy=True)
            store.fleet.tell(name, WorkerReport(host=name[:10], gpu=used, job=job, attempt=1))
        elif part == 2:
            store.records.fail(job, 1, FAILURES[number % 3 == 0])
        else:
            store.records.succeed(job, 1, [])
    store.queue.announce("gpu-node-9-7", 80)


def _waiting(store: Store, owner: str, label: str, memory_bytes: int) -> str:
    """A row that no server checks: it waits from its beginning."""
    with store.database.write() as session:
        now = store.database.now(session)
        upload = UploadRow(id=new_id(now), owner=owner, size=3, offset=3, sha256="ab" * 32, created_at=now)
        session.add(upload)
        session.flush()
        job = JobRow(
            id=new_id(now),
            owner=owner,
            upload_id=upload.id,
            state=JobState.queued.value,
            label=label,
            options={},
            memory_bytes=memory_bytes,
            checked_at=now,
            progress=Progress().model_dump(mode="json"),
            warnings=[],
            results=[],
            created_at=now,
            updated_at=now,
            retention_seconds=1000,
        )
        session.add(job)
        return job.id
