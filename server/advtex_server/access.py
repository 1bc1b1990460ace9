"""Who may pass: the key is checked before a single byte of a body is read, and bodies that are no uploads are small."""

from __future__ import annotations

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_server.errors import respond
from advtex_server.refusal import ApiError
from advtex_store.accounts import Accounts

API = "/v1/"
UPLOADS = "/v1/uploads"


class AccessMiddleware:
    """Sets `scope["state"]["caller"]` for everything below `/v1/`."""

    def __init__(self, app: ASGIApp, accounts: Accounts, max_body_bytes: int) -> None:
        self.app = app
        self.accounts = accounts
        self.max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            if scope["path"].startswith(API):
                scope.setdefault("state", {})["caller"] = await self._caller(headers)
            if not scope["path"].startswith(UPLOADS):
                receive = self._limited(headers, receive)
        except Exception as error:
            await respond(scope, error)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    async def _caller(self, headers: Headers) -> object:
        kind, _, key = headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer":
            raise _unauthorized("there is no key", "send yours as 'Authorization: Bearer adv_…'")
        caller = await run_in_threadpool(self.accounts.authenticate, key.strip())
        if caller is None:
            raise _unauthorized(
                "the key is unknown, revoked or expired", "ask for a new one; `advtex-server keys create` makes it"
            )
        return caller

    def _limited(self, headers: Headers, receive: Receive) -> Receive:
        # An HTTPException, because FastAPI turns all others that come up while a body is read into a plain 400.
        too_large = HTTPException(413, f"the body is larger than {self.max_body_bytes} bytes")
        declared = headers.get("content-length", "0")
        if declared.isdigit() and int(declared) > self.max_body_bytes:
            raise too_large
        seen = 0

        async def limited() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > self.max_body_bytes:
                raise too_large
            return message

        return limited


def _unauthorized(message: str, remedy: str) -> ApiError:
    detail = ErrorDetail(code="bad_key", where="Authorization", message=message, remedy=remedy)
    return ApiError(ErrorCode.unauthorized, f"{message}: {remedy}", [detail])
