"""Submitting a scan, step by step, without sending anything itself.

`submission` is a generator: it yields each Call to be made, receives its answer (or the ClientError that it ended in),
and returns the job. Both clients drive it.
"""

from __future__ import annotations

import secrets
from collections.abc import Generator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from advtex_client import _calls as calls
from advtex_client._sending import Step, sending
from advtex_client.errors import ClientError, ConflictError, NotFoundError, ScanRejectedError
from advtex_client.memory import Submission, SubmissionMemory
from advtex_client.uploads import OnBytes, PackedScan
from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.jobs import JobSpec, JobView
from advtex_contract.options import JobOptions
from advtex_scan.check import check_scan

Steps = Generator[Step, Any, JobView]


def ensure_submittable(scan: Path, label: str) -> None:
    """The checks that the server makes too, before anything is sent. Raises ScanRejectedError with every finding."""
    try:
        JobSpec(upload_id="", label=label)
    except ValidationError as error:
        raise ClientError(f"label {label!r} cannot be used: {error.errors()[0]['msg']}") from error
    report = check_scan(scan)
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
    options: JobOptions,
    label: str,
    *,
    retries: int,
    new: bool = False,
    on_bytes: OnBytes | None = None,
) -> Steps:
    """Go on with a remembered submission, or begin one. With `new`, a job of its own is made in any case."""
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
    spec = JobSpec(upload_id=known.upload_id, options=options, label=label)
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
    """The submission with an upload that the server holds whole."""
    upload = yield from sending(scan, retries, on_bytes, known.upload_id)
    if upload.id != known.upload_id:
        known = known.model_copy(update={"upload_id": upload.id})
        memory.save(known)
    return known
