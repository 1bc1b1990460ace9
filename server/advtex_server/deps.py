"""What routes ask for: the service, and the caller with the scope that the route needs."""

from __future__ import annotations

from typing import Annotated, cast

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from advtex_contract.errors import ErrorCode
from advtex_server.intake import Intake
from advtex_server.refusal import ApiError
from advtex_server.service import Service
from advtex_server.webhooks import WebhookService
from advtex_store.accounts import Caller

# Only for the API's description: AccessMiddleware has checked the key before any route is entered.
_bearer = HTTPBearer(auto_error=False, description="`adv_<id>_<secret>`", scheme_name="key")
_Key = Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]


async def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


async def _intake(request: Request) -> Intake:
    return cast(Intake, request.app.state.intake)


async def _webhooks(request: Request) -> WebhookService:
    return cast(WebhookService, request.app.state.webhooks)


async def anyone(request: Request, _key: _Key) -> Caller:
    """The caller, whatever the key's scopes."""
    return cast(Caller, request.state.caller)


async def reader(request: Request, _key: _Key) -> Caller:
    """The caller, who may look."""
    return _with_scope(request, "read")


async def writer(request: Request, _key: _Key) -> Caller:
    """The caller, who may change things."""
    return _with_scope(request, "write")


def _with_scope(request: Request, scope: str) -> Caller:
    caller = cast(Caller, request.state.caller)
    if scope not in caller.scopes:
        raise ApiError(ErrorCode.forbidden, f"this key lacks the scope {scope!r}")
    return caller


Anyone = Annotated[Caller, Depends(anyone)]
Reader = Annotated[Caller, Depends(reader)]
Writer = Annotated[Caller, Depends(writer)]
TheIntake = Annotated[Intake, Depends(_intake)]
TheWebhooks = Annotated[WebhookService, Depends(_webhooks)]
TheService = Annotated[Service, Depends(_service)]
