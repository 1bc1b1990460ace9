"""For those who run the service: is it alive, is it ready, what does it do."""

from __future__ import annotations

from typing import cast

from fastapi import APIRouter, Request, Response

from advtex_contract.errors import ErrorCode
from advtex_contract.health import Alive, KeyView, PartView, Readiness
from advtex_server.deps import Anyone, TheService
from advtex_server.health import checks
from advtex_server.metrics_access import MetricsAccess
from advtex_server.refusal import WITH_KEY, refuses

router = APIRouter()


@router.get("/healthz", tags=["operation"])
async def healthz() -> Alive:
    """The process answers."""
    return Alive()


@router.get(
    "/readyz",
    tags=["operation"],
    responses={503: {"model": Readiness, "description": "something essential does not work"}},
)
def readyz(service: TheService, response: Response) -> Readiness:
    """Whether work can be accepted, with one sentence per part that does not work."""
    found = checks(service.store, service.settings, service.loops)
    ready = all(check.ok or not check.essential for check in found)
    response.status_code = 200 if ready else 503
    parts = {c.name: PartView(ok=c.ok, essential=c.essential, message=c.message) for c in found}
    return Readiness(ready=ready, checks=parts)


@router.get("/v1/key", tags=["keys"], responses=WITH_KEY)
def get_key(caller: Anyone, service: TheService) -> KeyView:
    """The key that this is asked with: what it may do, until when, and how much is left of its limits."""
    return service.key(caller)


@router.get(
    "/metrics",
    tags=["operation"],
    response_class=Response,
    responses={200: {"content": {"text/plain": {}}}, **WITH_KEY, **refuses(ErrorCode.not_found)},
)
async def metrics(request: Request) -> Response:
    """Prometheus metrics: for everybody, unless the operator has given them a port of their own or lets them ask for a
    key with the scope `admin`."""
    return await cast(MetricsAccess, request.app.state.metrics_access).beside_the_api(request)
