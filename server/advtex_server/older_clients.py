"""Clients of ours from before jobs could be `checking`, which refuse an answer that holds a state they do not know.

They are told `queued`, with the reason why the job still waits. A client that takes states it does not know as those of
a job that goes on says so in a header, and is told the truth, as everybody else is.
"""

from __future__ import annotations

from contextvars import ContextVar

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from advtex_contract.jobs import ANY_STATE_HEADER, BatchView, JobState, JobView

OURS = "advtex-client/"

_older = ContextVar("older", default=False)


class OlderClientsMiddleware:
    """Remembers which kind of client asks, for `told` and `told_batch`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            _older.set(headers.get("user-agent", "").startswith(OURS) and ANY_STATE_HEADER not in headers)
        await self.app(scope, receive, send)


def told(view: JobView) -> JobView:
    """The job as the client that asks can read it."""
    if _older.get() and view.state == JobState.checking:
        return view.model_copy(update={"state": JobState.queued})
    return view


def told_batch(view: BatchView) -> BatchView:
    """The batch as the client that asks can read it."""
    if not (_older.get() and JobState.checking in view.states):
        return view
    states = dict(view.states)
    states[JobState.queued] = states.get(JobState.queued, 0) + states.pop(JobState.checking)
    return view.model_copy(update={"states": states})
