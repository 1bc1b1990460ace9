"""For those who run the service: is it alive, is it ready, what does it do."""

from __future__ import annotations

from typing import cast

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from advtex_server.deps import TheService
from advtex_server.health import checks
from advtex_server.metrics import Metrics

router = APIRouter(tags=["operation"])


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", responses={503: {"description": "something essential does not work"}})
def readyz(service: TheService) -> Response:
    """Whether work can be accepted, with one sentence per part that does not work."""
    found = checks(service.store, service.settings)
    ready = all(check.ok or not check.essential for check in found)
    content = {
        "ready": ready,
        "checks": {c.name: {"ok": c.ok, "essential": c.essential, "message": c.message} for c in found},
    }
    return JSONResponse(content, 200 if ready else 503)


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def metrics(request: Request) -> Response:
    """Prometheus metrics."""
    body, media_type = cast(Metrics, request.app.state.metrics).exposition()
    return Response(body, media_type=media_type)
