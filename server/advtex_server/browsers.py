"""Browsers: who is signed in, which requests come from the page itself, and what every answer tells a browser."""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.errors import ErrorCode
from advtex_server.authentication import KNOWN_SECONDS, remember, unauthorized
from advtex_server.refusal import ApiError
from advtex_store.accounts import Caller
from advtex_store.sessions import Sessions

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Of every answer that does not say otherwise; pages have a policy of their own."""


class BrowserSessions:
    """Knows callers by their session, without a look at the database for every request."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions = sessions
        self._known: OrderedDict[bytes, tuple[Caller, float]] = OrderedDict()

    async def find(self, connection: HTTPConnection) -> Caller | None:
        """Whose browser sends this request; None if it is not signed in (any more)."""
        token = session_token(connection)
        if not token:
            return None
        digest = hashlib.sha256(token.encode()).digest()
        known = self._known.get(digest)
        if known is not None and known[1] > time.monotonic():
            return known[0]
        caller = await run_in_threadpool(self._sessions.caller, token)
        if caller is None:
            self._known.pop(digest, None)
        else:
            remember(self._known, digest, (caller, time.monotonic() + KNOWN_SECONDS))
        return caller

    async def caller(self, connection: HTTPConnection) -> Caller:
        """The same for a call of the API. ApiError 401, or 403 for a change that another site asks for."""
        if connection.scope["method"] not in SAFE_METHODS:
            check_same_origin(connection.headers)
        caller = await self.find(connection)
        if caller is None:
            raise unauthorized("the session has ended", "sign in again")
        return caller

    async def end(self, connection: HTTPConnection) -> None:
        """Sign the browser out."""
        token = session_token(connection)
        self._known.pop(hashlib.sha256(token.encode()).digest(), None)
        await run_in_threadpool(self._sessions.end, token)


def cookie_name(headers: Headers) -> str:
    """With the port: cookies know none, and there may be several servers on one machine."""
    port = headers.get("host", "").rpartition("]")[2].partition(":")[2]
    return f"advtex_session_{port}" if port.isdigit() else "advtex_session"


def session_token(connection: HTTPConnection) -> str:
    """The token of the browser's session, empty without one."""
    return connection.cookies.get(cookie_name(connection.headers), "")


def check_same_origin(headers: Headers) -> None:
    """ApiError unless the browser says that one of this server's own pages sends the request.

    The cookie is SameSite=Strict already, but other ports of the same host are the same site.
    """
    site, origin = headers.get("sec-fetch-site"), headers.get("origin", "")
    same = site == "same-origin" if site else bool(origin) and urlsplit(origin).netloc == headers.get("host")
    if not same:
        raise ApiError(ErrorCode.forbidden, "a session can change things from this server's own pages only")


class BrowserHeadersMiddleware:
    """Adds HEADERS to every answer."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, guarded)
