"""Who may read `/metrics`, and the port of its own that it can have."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from advtex_contract.errors import ErrorCode
from advtex_server.authentication import Authenticator
from advtex_server.errors import respond
from advtex_server.metrics import Metrics
from advtex_server.refusal import ApiError
from advtex_server.settings import ServerSettings

PATH = "/metrics"
SCOPE = "admin"


class MetricsAccess:
    """The metrics for those who may see them."""

    def __init__(self, metrics: Metrics, authenticator: Authenticator, settings: ServerSettings) -> None:
        self._metrics = metrics
        self._authenticator = authenticator
        self._settings = settings

    async def beside_the_api(self, request: Request) -> Response:
        """ApiError 404 where they have a port of their own."""
        if self._settings.metrics_port is not None:
            raise ApiError(ErrorCode.not_found, "the metrics of this server have a port of their own")
        return await self._answer(request)

    async def at_their_port(self, request: Request) -> Response:
        """The same application's, at the other port."""
        try:
            return await self._answer(request)
        except Exception as error:
            return respond(request.scope, error)

    async def _answer(self, request: Request) -> Response:
        if self._settings.metrics_key:
            address = request.client.host if request.client else ""
            caller = await self._authenticator.caller(request.headers.get("authorization", ""), address)
            if SCOPE not in caller.scopes:
                raise ApiError(ErrorCode.forbidden, f"this key lacks the scope {SCOPE!r}")
        body, media_type = await run_in_threadpool(self._metrics.exposition)
        return Response(body, media_type=media_type)


def metrics_app(access: MetricsAccess) -> Starlette:
    """What listens at the port of the metrics, beside the API or a dispatcher in one process."""
    endpoint: Callable[[Request], Awaitable[Response]] = access.at_their_port
    return Starlette(routes=[Route(PATH, endpoint)])
