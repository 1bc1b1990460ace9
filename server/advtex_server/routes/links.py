"""Links to one file of a result for apps that send neither key nor session: made by the page, read by anybody."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Response

from advtex_server.deps import Reader, TheService
from advtex_server.routes.jobs import JobId, sent

router = APIRouter(include_in_schema=False)


@router.post("/v1/jobs/{job_id}/links/{name:path}", status_code=201)
def make_link(job_id: JobId, name: str, caller: Reader, service: TheService) -> dict[str, str]:
    """An address on this server."""
    return {"url": service.link(caller, job_id, name)}


@router.get("/links/{token}/{job_id}/{name:path}")
def follow_link(
    token: str,
    job_id: JobId,
    name: str,
    service: TheService,
    range_: Annotated[str, Header(alias="range")] = "",
    if_range: Annotated[str, Header()] = "",
    if_none_match: Annotated[str, Header()] = "",
) -> Response:
    """The file, as `GET /v1/jobs/{job_id}/results/{name}` sends it."""
    return sent(service, service.linked(token, job_id, name), range_, if_range, if_none_match)
