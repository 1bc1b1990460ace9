"""Jobs whose scan was found good, without a check."""

from __future__ import annotations

from typing import Any

from advtex_contract.jobs import JobSpec


def queued_job(store: Any, owner: str, spec: JobSpec, memory_bytes: int = 0, **given: Any) -> str:
    """A new job in state `queued`. store: anything with `submissions` and `checks`, and no other job to check."""
    job_id: str = store.submissions.create_job(owner, spec, **given).id
    claim = store.checks.claim()
    assert claim.job_id == job_id, "another job waited for its check"
    store.checks.passed(claim, [], memory_bytes)
    return job_id
