"""Batches: jobs with a common name, which the client chose when it made them."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import BatchId, BatchLimits, BatchPage, BatchView
from advtex_server.deps import Reader, TheService, Writer
from advtex_server.refusal import WITH_KEY, refuses

router = APIRouter(prefix="/v1/batches", tags=["batches"], responses=WITH_KEY)

OF_A_BATCH = refuses(ErrorCode.not_found, 422)


@router.get("", responses=refuses(422))
def list_batches(
    caller: Reader,
    service: TheService,
    cursor: Annotated[str | None, Query(pattern="^[0-9a-f]{1,64}$", description="`next_cursor` of a page")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> BatchPage:
    """Your batches, newest first; `eta_seconds` is left out."""
    return service.batches.page(caller.owner, cursor, limit)


@router.get("/{batch_id}", responses=OF_A_BATCH)
def get_batch(batch_id: BatchId, caller: Reader, service: TheService) -> BatchView:
    """How many jobs are in which state, and how long the rest takes at the step rates that were measured."""
    return service.batches.view(caller.owner, batch_id)


@router.post("/{batch_id}/cancel", responses=OF_A_BATCH)
def cancel_batch(batch_id: BatchId, caller: Writer, service: TheService) -> BatchView:
    """Cancel every job that has not ended."""
    return service.batches.cancel(caller.owner, batch_id)


@router.post("/{batch_id}/pause", responses=OF_A_BATCH)
def pause_batch(batch_id: BatchId, caller: Writer, service: TheService) -> BatchView:
    """Keep every job that waits waiting, until the batch is resumed. What runs goes on."""
    return service.batches.pause(caller.owner, batch_id, True)


@router.post("/{batch_id}/resume", responses=OF_A_BATCH)
def resume_batch(batch_id: BatchId, caller: Writer, service: TheService) -> BatchView:
    """Let the jobs of a paused batch begin again, each when its turn comes."""
    return service.batches.pause(caller.owner, batch_id, False)


@router.put("/{batch_id}/limits", status_code=204, responses=refuses(ErrorCode.bad_request, 422))
def limit_batch(batch_id: BatchId, limits: BatchLimits, caller: Writer, service: TheService) -> Response:
    """Say how many of its jobs run at a time, also before the first one is made."""
    service.batches.limit(caller.owner, batch_id, limits)
    return Response(status_code=204)


@router.post(
    "/{batch_id}/retry-failed", responses=OF_A_BATCH | refuses(ErrorCode.rate_limited, ErrorCode.quota_exceeded)
)
def retry_batch(batch_id: BatchId, caller: Writer, service: TheService) -> BatchView:
    """Queue every failed job again; each goes on from its checkpoint."""
    return service.batches.retry_failed(caller, batch_id)
