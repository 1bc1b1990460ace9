"""Submitting a scan, step by step, without sending anything itself.

`submission` is a generator: it yields each Call to be made, receives its answer (or the ClientError that it ended in),
and returns the job. Both clients drive it.
"""

from __future__ import annotations

import secrets
from collections.abc import Generator
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from advtex_client import _calls as calls
from advtex_client._sending import Step, sending
from advtex_client.errors import ClientError, ConflictError, NotFoundError, ScanRejectedError
from advtex_client.submissions import Submission, SubmissionMemory
from advtex_client.uploads import OnBytes, PackedScan
from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.jobs import JobSpec, JobView
from advtex_contract.options import JobOptions
from advtex_scan.check import check_scan

Steps = Generator[Step, Any, JobView]


def job_spec(
    options: JobOptions | None = None,
    label: str = "",
    batch: str | None = None,
    priority: int = 0,
    retention_seconds: int | None = None,
    deadline: datetime | None = None,
) -> JobSpec:
    """Return what to ask for, with no upload yet. Raises ClientError for what no server would accept."""
    options = options or JobOptions()
    try:
        return JobSpec(
            upload_id="",
            options=options,
            label=label,
            batch=batch,
            priority=priority,
            retention_seconds=retention_seconds,
            deadline=deadline,
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise ClientError(f"{first['loc'][0]} {first['input']!r} cannot be used: {first['msg']}") from error


def ensure_submittable(scan: Path, options: JobOptions) -> None:
    """Make the server's check before anything is sent. Raises ScanRejectedError with every finding."""
    report = check_scan(scan, options.layout)
    if report.ok:
        return
    details = [
        ErrorDetail(severity=f.severity, code=f.code, where=f.where, message=f.message, remedy=f.remedy)
        for f in report.findings
    ]
    errors = sum(detail.severity == "error" for detail in details)
    raise ScanRejectedError(f"{scan} cannot be textured: {errors} problem(s) found, nothing was sent", details)


def submission(
    memory: SubmissionMemory,
    scan: PackedScan,
    spec: JobSpec,
    *,
    retries: int,
    new: bool = False,
    on_bytes: OnBytes | None = None,
) -> Steps:
    """Go on with a remembered submission, or begin one. With `new`, a job of its own is made in any case.

    spec: what to do with the scan; its upload is filled in.
    """
    known = memory.load()
    if known.job_id is not None and not new:
        try:
            job: JobView = yield calls.get_job(known.job_id)
            return job
        except NotFoundError:  # deleted or expired: another one is wanted
            new = True
    if new:
        known = Submission(salt=f"-{secrets.token_hex(8)}", upload_id=known.upload_id)
        memory.save(known)
    known = yield from _uploaded(memory, known, scan, retries, on_bytes)
    assert known.upload_id is not None
    spec = spec.model_copy(update={"upload_id": known.upload_id})
    try:
        job = yield calls.create_job(spec, memory.idempotency_key(known))
    except ConflictError as error:
        if error.error.code is not ErrorCode.idempotency_mismatch:
            raise
        raise ClientError(
            "this scan was submitted before with the same options and label, but from elsewhere or not as remembered "
            "here; `advtex-client list` shows that job, and --new makes another one"
        ) from error
    memory.save(known.model_copy(update={"job_id": job.id}))
    return job


def _uploaded(
    memory: SubmissionMemory, known: Submission, scan: PackedScan, retries: int, on_bytes: OnBytes | None
) -> Generator[Step, Any, Submission]:
    """Return the submission with an upload that the server holds whole."""
    upload = yield from sending(scan, retries, on_bytes, known.upload_id)
    if upload.id != known.upload_id:
        known = known.model_copy(update={"upload_id": upload.id})
        memory.save(known)
    return known
