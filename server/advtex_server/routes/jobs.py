"""Jobs: create, look at, follow, cancel, retry, delete, and their results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ParamSpec

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import ID_PATTERN, BatchId, JobPage, JobSpec, JobState, JobView, Label
from advtex_contract.live import LiveView
from advtex_server.deps import Reader, TheService, Writer
from advtex_server.events import stream_events
from advtex_server.ranges import chosen_range
from advtex_server.refusal import WITH_KEY, refuses
from advtex_server.service import Service
from advtex_server.streams import while_welcome
from advtex_store.results import StoredFile
from advtex_store.submissions import JobFilter

P = ParamSpec("P")
router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=WITH_KEY)

JobId = Annotated[str, Path(pattern=ID_PATTERN)]
OF_A_JOB = refuses(ErrorCode.not_found, 422)

EVENT = {  # before OpenAPI 3.2 a stream's schema is that of each event
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"type": "string", "enum": ["state", "progress", "job"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}


async def _json(make: Callable[P, BaseModel], *args: P.args, **kwargs: P.kwargs) -> Response:
    """What many clients ask for again and again: made and written out in one go on another thread, and not checked
    against its own model once more, which costs as much as all the rest."""
    body = await run_in_threadpool(lambda: make(*args, **kwargs).model_dump_json())
    return Response(body, media_type="application/json")


@router.post(
    "",
    status_code=201,
    responses=refuses(
        ErrorCode.bad_request,
        ErrorCode.not_found,
        ErrorCode.conflict,
        ErrorCode.idempotency_in_flight,
        ErrorCode.not_ready,
        422,
        ErrorCode.invalid_options,
        ErrorCode.invalid_source,
        ErrorCode.idempotency_mismatch,
        ErrorCode.rate_limited,
        ErrorCode.quota_exceeded,
        ErrorCode.insufficient_storage,
    )
    | {200: {"model": JobView, "description": "the key's job, made before"}},
)
def create_job(
    spec: JobSpec,
    caller: Writer,
    service: TheService,
    response: Response,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=200)] = None,
) -> JobView:
    """Texture the scan of a finished upload, or one that the server can read.

    The job is `checking` until its scan is checked: a good one is `queued` then, a bad one `rejected` with every
    finding.
    """
    view, new = service.create_job(caller, spec, idempotency_key)
    if not new:
        response.status_code = 200
    response.headers["Location"] = f"/v1/jobs/{view.id}"
    return view


@router.get("", response_model=JobPage, responses=refuses(422))
async def list_jobs(
    caller: Reader,
    service: TheService,
    state: JobState | None = None,
    label: Label | None = None,
    batch: BatchId | None = None,
    cursor: Annotated[str | None, Query(pattern="^[0-9a-f]{1,64}$", description="`next_cursor` of a page")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> Response:
    """Your jobs, newest first."""
    return await _json(service.jobs, caller.owner, JobFilter(state, label, batch), cursor, limit)


@router.get("/{job_id}", response_model=JobView, responses=OF_A_JOB)
async def get_job(job_id: JobId, caller: Reader, service: TheService) -> Response:
    """One job."""
    return await _json(service.job, caller.owner, job_id)


@router.post("/{job_id}/cancel", responses=OF_A_JOB | refuses(ErrorCode.conflict))
def cancel_job(job_id: JobId, caller: Writer, service: TheService) -> JobView:
    """A running job is stopped with a checkpoint; any other ends at once."""
    return service.cancel(caller.owner, job_id)


@router.post(
    "/{job_id}/retry",
    responses=OF_A_JOB | refuses(ErrorCode.conflict, ErrorCode.rate_limited, ErrorCode.quota_exceeded),
)
def retry_job(job_id: JobId, caller: Writer, service: TheService) -> JobView:
    """A failed or canceled job goes on from its checkpoint, or with the check of its scan."""
    return service.retry(caller, job_id)


@router.delete("/{job_id}", status_code=204, responses=OF_A_JOB | refuses(ErrorCode.conflict))
def delete_job(job_id: JobId, caller: Writer, service: TheService) -> Response:
    """Remove an ended job with its results."""
    service.delete(caller.owner, job_id)
    return Response(status_code=204)


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses=OF_A_JOB | {200: {"content": {"text/event-stream": {"schema": EVENT}}}},
)
def job_events(
    job_id: JobId,
    caller: Reader,
    service: TheService,
    request: Request,
    last_event_id: Annotated[str, Header(description="replay what came after this event")] = "",
) -> Response:
    """Server-sent events until the job has ended.

    `state` and `progress` replay every change of state and of stage (small objects with `kind`); `job` carries the
    whole job as `GET /v1/jobs/{job_id}` shows it, whenever it has changed. Ids grow.
    """
    service.job(caller.owner, job_id)
    state = request.app.state
    after = int(last_event_id) if last_event_id.isascii() and last_event_id.isdigit() else 0
    events = stream_events(state.lookout, caller.owner, job_id, min(after, 2**62), state.stopping)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    events = while_welcome(events, request.state.ask_caller)
    return StreamingResponse(events, media_type="text/event-stream", headers=headers)


@router.get("/{job_id}/live", response_model=LiveView, responses=OF_A_JOB)
async def get_live(job_id: JobId, caller: Reader, service: TheService) -> Response:
    """A running job's texture as it is now: curves, and small pictures. Fetch it again when the job's step has grown.

    What an attempt has shown stays until the next one shows something.
    """
    return await _json(service.live, caller.owner, job_id)


@router.get(
    "/{job_id}/live/{name}",
    response_class=Response,
    responses=OF_A_JOB | {200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}}},
)
def get_live_picture(job_id: JobId, name: str, caller: Reader, service: TheService) -> Response:
    """A picture that `GET /v1/jobs/{job_id}/live` names."""
    headers = {"Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
    return Response(service.live_picture(caller.owner, job_id, name), media_type="image/jpeg", headers=headers)


@router.get(
    "/{job_id}/results/{name:path}",
    response_class=StreamingResponse,
    responses=OF_A_JOB
    | refuses(ErrorCode.not_ready, 416)
    | {
        200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}},
        206: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}},
        304: {"description": "unchanged"},
    },
)
def get_result(
    job_id: JobId,
    name: str,
    caller: Reader,
    service: TheService,
    range_: Annotated[str, Header(alias="range", description="one byte range")] = "",
    if_range: Annotated[str, Header()] = "",
    if_none_match: Annotated[str, Header()] = "",
) -> Response:
    """A result file, whole or in part. Its ETag is its SHA-256."""
    return sent(service, service.result(caller.owner, job_id, name), range_, if_range, if_none_match)


def sent(service: Service, file: StoredFile, range_: str, if_range: str, if_none_match: str) -> Response:
    """The file as these headers of the request ask for it."""
    etag = f'"{file.sha256}"'
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Cache-Control": "private, no-cache"}
    if etag in [tag.strip().removeprefix("W/") for tag in if_none_match.split(",")]:
        return Response(status_code=304, headers=headers)
    span = chosen_range(range_, file.size) if if_range in ("", etag) else None
    start, end = span or (0, file.size)
    headers |= {
        "Content-Length": str(end - start),
        "Content-Disposition": f'attachment; filename="{file.name.rpartition("/")[2]}"',
        "X-Content-SHA256": file.sha256,
        "X-Content-Type-Options": "nosniff",
    }
    if span is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{file.size}"
    body = service.store.blobs.stream(file.key, start, end)
    return StreamingResponse(body, 200 if span is None else 206, headers, file.content_type)
