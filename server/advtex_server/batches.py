"""What a caller can do with a batch, without HTTP. All calls block."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

import structlog

from advtex_contract.jobs import TERMINAL, BatchLimits, BatchPage, BatchView, JobState
from advtex_server.older_clients import told_batch
from advtex_store.accounts import Caller
from advtex_store.batches import BatchSummary
from advtex_store.errors import IllegalTransition, RecordNotFound
from advtex_store.store import Store

log = structlog.get_logger("advtex.server")


class BatchService:
    """Every job is changed by itself: one that ends meanwhile is passed over."""

    def __init__(self, store: Store, wake: Callable[[], None]) -> None:
        self.store = store
        self.wake = wake

    def view(self, owner: str, batch_id: str) -> BatchView:
        return told_batch(batch_view(self.store.batches.batch(owner, batch_id)))

    def page(self, owner: str, cursor: str | None, limit: int) -> BatchPage:
        found, following = self.store.batches.batches(owner, cursor, limit)
        return BatchPage(batches=[told_batch(batch_view(batch)) for batch in found], next_cursor=following)

    def cancel(self, owner: str, batch_id: str) -> BatchView:
        self.store.batches.batch(owner, batch_id)
        for job_id in self.store.batches.jobs(owner, batch_id, set(JobState) - TERMINAL):
            with suppress(IllegalTransition, RecordNotFound):
                self.store.records.cancel(job_id, owner)
        log.info("cancel asked", batch=batch_id)
        return self.view(owner, batch_id)

    def pause(self, owner: str, batch_id: str, paused: bool) -> BatchView:
        self.store.batches.pause(owner, batch_id, paused)
        log.info("paused" if paused else "resumed", batch=batch_id)
        self.wake()
        return self.view(owner, batch_id)

    def limit(self, owner: str, batch_id: str, limits: BatchLimits) -> None:
        self.store.batches.limit(owner, batch_id, limits.max_running)
        log.info("limited", batch=batch_id, max_running=limits.max_running)
        self.wake()

    def retry_failed(self, caller: Caller, batch_id: str) -> BatchView:
        self.store.batches.batch(caller.owner, batch_id)
        for job_id in self.store.batches.jobs(caller.owner, batch_id, {JobState.failed}):
            with suppress(IllegalTransition, RecordNotFound):
                self.store.records.retry(job_id, caller.owner, max_active_jobs=caller.max_active_jobs)
        log.info("retry", batch=batch_id)
        self.wake()
        return self.view(caller.owner, batch_id)


def batch_view(batch: BatchSummary) -> BatchView:
    """The summary as the API shows it."""
    return BatchView(
        id=batch.id,
        jobs=sum(batch.states.values()),
        states=dict(batch.states),
        finished=batch.finished,
        eta_seconds=batch.eta_seconds,
        paused=batch.paused,
        max_running=batch.max_running,
        created_at=datetime.fromtimestamp(batch.created_at, UTC),
        updated_at=datetime.fromtimestamp(batch.updated_at, UTC),
    )
