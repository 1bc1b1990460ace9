"""Who may pass: the key or the browser's session is checked before a single byte of a body is read, and bodies that are
no uploads are small."""

from __future__ import annotations

import functools

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_server.authentication import Authenticator
from advtex_server.browsers import BrowserSessions, session_token
from advtex_server.errors import respond
from advtex_store.accounts import Caller

API = "/v1/"
UPLOADS = "/v1/uploads"


class AccessMiddleware:
    """Sets `scope["state"]["caller"]`, and `ask_caller` that finds out again, for everything below `/v1/`."""

    def __init__(
        self, app: ASGIApp, authenticator: Authenticator, browser_sessions: BrowserSessions, max_body_bytes: int
    ) -> None:
        self.app = app
        self.authenticator = authenticator
        self.browser_sessions = browser_sessions
        self.max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            if scope["path"].startswith(API):
                ask = functools.partial(self._caller, HTTPConnection(scope))
                scope.setdefault("state", {}).update(caller=await ask(), ask_caller=ask)
            if not scope["path"].startswith(UPLOADS):
                receive = self._limited(headers, receive)
        except Exception as error:
            await respond(scope, error)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    async def _caller(self, connection: HTTPConnection) -> Caller:
        authorization = connection.headers.get("authorization", "")
        if not authorization and session_token(connection):
            return await self.browser_sessions.caller(connection)
        return await self.authenticator.caller(authorization, connection.client.host if connection.client else "")

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
