"""Submitting a batch: every item becomes one job, however often the submission is broken off and run again."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from advtex_client._display import finding_lines
from advtex_client._submission import job_spec
from advtex_client.client import Client
from advtex_client.errors import ApiError, AuthError, BusyError, ClientError, NetworkError, NotFoundError
from advtex_client.manifests import BatchItem
from advtex_client.submissions import SubmissionMemory, write_whole
from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import PENDING, BatchView, JobSpec, JobView
from advtex_contract.options import JobOptions

REPORT, THUMBNAIL = "report.json", "previews/thumbnail.jpg"
AT_ONCE = 4  # requests for scans by reference and for results; scans that are sent go one after the other
ASKED_WHY = 100  # jobs that are asked why they wait
FULL_SECONDS = 15.0  # between looks whether a quota has room again

OnFull = Callable[[ClientError], None]
"""Called when the key's quota is used up and the submission waits for room."""


@dataclass(frozen=True)
class Outcome:
    """What became of an item: a job, or the reason why there is none."""

    item: BatchItem
    job: JobView | None = None
    error: ClientError | None = None


class BatchRun(BaseModel):
    """What `batch resume` needs to know about a `batch submit`."""

    model_config = ConfigDict(extra="ignore")

    place: Path
    by_reference: bool
    options: JobOptions
    priority: int
    retention_seconds: int | None = None
    deadline: datetime | None = None


def remember(server: str, batch_id: str, run: BatchRun, folder: Path | None = None) -> None:
    """Keep how a batch was submitted."""
    write_whole(_path(server, batch_id, folder), run.model_dump_json())


def remembered(server: str, batch_id: str, folder: Path | None = None) -> BatchRun:
    """Return how a batch was submitted on this computer. Raises ClientError if it was not."""
    try:
        return BatchRun.model_validate_json(_path(server, batch_id, folder).read_bytes())
    except (FileNotFoundError, ValidationError) as error:
        raise ClientError(
            f"this computer does not remember how batch {batch_id} was submitted; run `batch submit` again with "
            f"--id {batch_id}: what is there already is not made twice"
        ) from error


def submit_batch(
    client: Client, batch_id: str, items: Sequence[BatchItem], on_full: OnFull = lambda _: None
) -> Iterator[Outcome]:
    """Yield one outcome per item, as they come. A scan that is refused does not stop the others; a lost line or a wrong
    key raises, and running it again goes on."""
    for item in items:
        _spec(batch_id, item)  # nothing is sent if one cannot be
    sent = [item for item in items if item.path is not None]
    referred = [item for item in items if item.path is None]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        yield from pool.map(lambda item: _submitted(client, batch_id, item, on_full), referred)
    for item in sent:
        yield _submitted(client, batch_id, item, on_full)


def result_rows(client: Client, batch_id: str) -> Iterator[dict[str, Any]]:
    """Yield a batch's jobs, sorted by label, for a table: what each came to, and its scores where there are any."""
    for job in sorted(client.list_jobs(batch=batch_id), key=lambda job: (job.label, job.id)):
        row: dict[str, Any] = {"job": job.id, "label": job.label, "state": job.state, "steps": job.progress.steps}
        row["seconds"] = round(sum(job.progress.stage_seconds.values()), 1)
        if job.error is not None:
            row["error"] = job.error.message
        if any(file.name == REPORT for file in job.results):
            row["scores"] = _scores(client, job)
        yield row


def waiting_reasons(client: Client, batch: BatchView) -> list[str]:
    """Return why jobs of a batch wait, the most frequent reason first; of the newest ones, where there are many."""
    found: Counter[str] = Counter()
    for state in sorted(PENDING):
        if batch.states.get(state):
            jobs = islice(client.list_jobs(batch=batch.id, state=state), ASKED_WHY)
            found.update(job.waiting_reason for job in jobs if job.waiting_reason)
    return [reason for reason, _ in found.most_common()]


def report_rows(client: Client, batch_id: str, thumbnails: dict[str, bytes] | None = None) -> Iterator[dict[str, Any]]:
    """Yield a batch's jobs, sorted by label, with all that tells how each went. Put their pictures (JPEG), by the job's
    id, into `thumbnails`."""
    jobs = sorted(client.list_jobs(batch=batch_id), key=lambda job: (job.label, job.id))

    def row(job: JobView) -> dict[str, Any]:
        if thumbnails is not None and (picture := _result(client, job, THUMBNAIL)) is not None:
            thumbnails[job.id] = picture
        return _report_row(client, job)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        yield from pool.map(row, jobs)


def _report_row(client: Client, job: JobView) -> dict[str, Any]:
    stages = job.progress.stage_seconds
    row: dict[str, Any] = {"label": job.label, "job": job.id, "state": job.state, "attempt": job.attempt}
    row |= {"steps": job.progress.steps, "gpu_seconds": round(sum(stages.values()), 1), "stage_seconds": stages}
    if job.deadline is not None:
        row |= {"deadline": job.deadline.isoformat(), "late": job.late}
    if job.finished_at is not None:
        row["elapsed_seconds"] = round((job.finished_at - job.created_at).total_seconds(), 1)
    if job.error is not None:
        told = job.error.message
        row["reason"] = "\n".join([told, *finding_lines(d for d in job.error.details if d.message not in told)])
    elif job.waiting_reason:
        row["reason"] = job.waiting_reason
    return row | {"scores": _scores(client, job)}


def _scores(client: Client, job: JobView) -> dict[str, float]:
    """Return the means over the held-out views, from the job's report; empty if none was held out."""
    try:
        found = (json.loads(_result(client, job, REPORT) or b"{}").get("heldout") or {}).get("texture") or {}
        return {name: value for name, value in found.items() if name != "views" and _is_score(value)}
    except (ValueError, AttributeError):
        return {}


def _is_score(value: object) -> bool:
    return isinstance(value, float) and isfinite(value)


def _result(client: Client, job: JobView, name: str) -> bytes | None:
    """Return a small file of the job's results, None where it has none or is gone by now."""
    if not any(file.name == name for file in job.results):
        return None
    with TemporaryDirectory(prefix="advtex-") as folder, suppress(NotFoundError):
        (path,) = client.download_results(job, Path(folder), names=[name])
        return path.read_bytes()
    return None


def _submitted(client: Client, batch_id: str, item: BatchItem, on_full: OnFull) -> Outcome:
    while True:
        try:
            return Outcome(item, job=_submit(client, batch_id, item))
        except BusyError as error:
            if error.error.code is not ErrorCode.quota_exceeded:
                raise
            on_full(error)
            time.sleep(FULL_SECONDS)
        except (AuthError, NetworkError):
            raise
        except ClientError as error:
            if isinstance(error, ApiError) and error.status >= 500:
                raise
            return Outcome(item, error=error)


def _submit(client: Client, batch_id: str, item: BatchItem) -> JobView:
    memory = SubmissionMemory(client.config.url, "batch", batch_id, *item.identity)
    spec = _spec(batch_id, item)
    if item.path is not None:
        return client.submit_remembered(memory, item.path, spec)
    spec = spec.model_copy(update={"upload_id": None, "source": item.source})
    return client.create_job(spec, idempotency_key=memory.idempotency_key(memory.load()))


def _spec(batch_id: str, item: BatchItem) -> JobSpec:
    return job_spec(item.options, item.label, batch_id, item.priority, item.retention_seconds, item.deadline)


def _path(server: str, batch_id: str, folder: Path | None) -> Path:
    return SubmissionMemory(server, "batch", batch_id, folder=folder).path.with_suffix(".batch")
