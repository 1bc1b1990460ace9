"""The web page: HTML around the same API that everybody uses. What changes things is called at `/v1/`, not here."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast
from urllib.parse import parse_qs, quote

import jinja2
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import EXPLANATIONS, JOB_EXPLANATIONS, ErrorCode
from advtex_contract.jobs import RETRYABLE, STATES, JobState, Label
from advtex_contract.options import PRESET_COST, PRESET_HELP, Preset
from advtex_contract.stages import STAGE_LABELS
from advtex_options import Options, described
from advtex_options.methods import chosen_method
from advtex_options.options import kind_of
from advtex_server import static_files
from advtex_server.authentication import Authenticator
from advtex_server.browsers import BrowserSessions, check_same_origin, cookie_name
from advtex_server.deps import TheService
from advtex_server.errors import noted
from advtex_server.fleet import look_at_fleet
from advtex_server.overview import job_summary, stream_changes
from advtex_server.refusal import STATUS, ApiError
from advtex_server.routes.jobs import JobId
from advtex_server.streams import while_welcome
from advtex_server.waiting import tell_why
from advtex_store.accounts import Caller
from advtex_store.submissions import JobFilter

PAGE_JOBS = 30
PAGE_BATCHES = 8
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
# The viewer compiles WebAssembly, styles itself, and makes URLs of what it has loaded.
VIEWER_POLICY = (
    POLICY.replace("script-src 'self'", "script-src 'self' 'wasm-unsafe-eval'")
    .replace("style-src 'self'", "style-src 'self' 'unsafe-inline'")
    .replace("img-src 'self' data:", "img-src 'self' data: blob:")
    .replace("connect-src 'self'", "connect-src 'self' blob:")
)
DOCS_POLICY = POLICY.replace("style-src 'self'", "style-src 'self' 'unsafe-inline'")  # Swagger UI styles itself
_RETURN = re.compile(r"/(new|fleet|jobs/[0-9A-Za-z_-]{1,64})?(\?[A-Za-z0-9._%&=-]*)?")
_WORDS = {
    "states": {
        state: {"label": facts.label, "tone": facts.tone, "terminal": facts.terminal, "retryable": state in RETRYABLE}
        for state, facts in STATES.items()
    },
    "stages": STAGE_LABELS,
    "usual_method": chosen_method(Options.method, Options.preset),
}
_PRESETS = (Preset.auto, Preset.preview, Preset.standard, Preset.full, Preset.paper)  # by their cost

templates = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parents[1] / "templates"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
templates.policies["json.dumps_kwargs"] = {"sort_keys": False}  # stages come in their order


class SignInFirst(Exception):
    """The page is for those who are signed in."""


class PageRoute(APIRoute):
    """Failures are told in a page of their own rather than in JSON."""

    def get_route_handler(self) -> Callable[[Request], Awaitable[Response]]:  # type: ignore[override]
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                return await handle(request)
            except SignInFirst:
                query = f"?{request.url.query}" if request.url.query else ""
                return RedirectResponse(f"/sign-in?next={quote(request.url.path + query)}", 303)
            except Exception as error:
                told = noted(request.scope, error)
                return _page("error.html", None, status=told.status, message=told.body.message)

        return answer


router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/")
async def jobs_page(
    request: Request,
    service: TheService,
    state: str = "",
    label: Label = "",
    batch: Label = "",
    cursor: Annotated[str, Query(pattern="^[0-9a-f]{0,64}$")] = "",
) -> Response:
    """All jobs, newest first."""
    caller = await _reader(request)
    wanted = JobFilter(JobState(state) if state in STATES else None, label.strip() or None, batch or None)
    store = service.store
    now = await run_in_threadpool(store.overviews.now)
    rows, following = await run_in_threadpool(store.overviews.jobs, caller.owner, wanted, cursor or None, PAGE_JOBS)
    await run_in_threadpool(tell_why, store, caller.owner, rows)
    batches = await run_in_threadpool(service.batches.page, caller.owner, None, PAGE_BATCHES)
    data = {
        "jobs": [job_summary(row).model_dump(mode="json") for row in rows],
        "batches": [found.model_dump(mode="json") for found in batches.batches],
        "filter": {"state": wanted.state, "label": wanted.label, "batch": wanted.batch},
        "first": not cursor,
        "since": int(now * 1000),
    }
    return _page("jobs.html", caller, data=data, following=following, states=STATES)


@router.get("/new")
async def submit_page(request: Request, service: TheService) -> Response:
    """Give a scan."""
    caller = await _reader(request)
    data = {"max_upload_bytes": service.settings.max_upload_bytes}
    presets = [(preset, PRESET_HELP[preset], PRESET_COST[preset]) for preset in _PRESETS]
    return _page("new.html", caller, data=data, presets=presets, options=submit_options())


def submit_options() -> list[dict[str, Any]]:
    """The options of the form, as the template's macro `option` takes them; the preset is shown by itself."""
    return [
        {"name": name, "about": about, "kind": kind_of(name).__name__, "default": getattr(Options, name, None)}
        for name, about in described().items()
        if name != "preset"
    ]


@router.get("/jobs/{job_id}")
async def job_page(job_id: JobId, request: Request, service: TheService) -> Response:
    """One job and what came of it."""
    caller = await _reader(request)
    job = await run_in_threadpool(service.job, caller.owner, job_id)
    return _page("job.html", caller, VIEWER_POLICY, job=job, data=job.model_dump(mode="json"))


@router.get("/docs")
async def docs_page(request: Request) -> Response:
    """The API, to read and to try out with a key."""
    return _page("docs.html", await _sessions(request).find(request), DOCS_POLICY)


@router.get("/errors")
async def errors_page(request: Request) -> Response:
    """What each code of an error means, and what helps."""
    caller = await _sessions(request).find(request)
    return _page("errors.html", caller, answers=EXPLANATIONS, jobs=JOB_EXPLANATIONS, statuses=STATUS)


@router.get("/fleet")
async def fleet_page(request: Request, service: TheService) -> Response:
    """The fleet, for those who run it."""
    caller = await _admin(request)
    view = await run_in_threadpool(look_at_fleet, service.store)
    return _page("fleet.html", caller, data={"fleet": view.model_dump(mode="json"), "owner": caller.owner})


@router.get("/fleet/now")
async def fleet_now(request: Request, service: TheService) -> Response:
    """The same as JSON, for the page."""
    caller = await _sessions(request).find(request)
    if caller is None or "admin" not in caller.scopes:
        return Response(status_code=401 if caller is None else 403)
    view = await run_in_threadpool(look_at_fleet, service.store)
    return Response(view.model_dump_json(), media_type="application/json", headers={"Cache-Control": "no-store"})


@router.get("/changes")
async def changes(
    request: Request, service: TheService, after: int = 0, last_event_id: Annotated[str, Header()] = ""
) -> Response:
    """Server-sent events: every change of a job after a time in milliseconds."""
    caller = await _sessions(request).find(request)
    if caller is None or "read" not in caller.scopes:
        return Response(status_code=401)
    since = int(last_event_id) if last_event_id.isascii() and last_event_id.isdigit() else after
    stopping = request.app.state.stopping
    events = stream_changes(service.store, caller.owner, min(since, 2**50) / 1000, stopping)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    events = while_welcome(events, partial(_sessions(request).find, request))
    return StreamingResponse(events, media_type="text/event-stream", headers=headers)


@router.get("/sign-in")
async def sign_in_page(
    request: Request, service: TheService, token: str = "", next_: Annotated[str, Query(alias="next")] = "/"
) -> Response:
    """Ask for the key, or follow a link that needs none."""
    if token:
        seconds = service.settings.session_seconds
        session = await run_in_threadpool(service.store.sessions.follow, token, seconds)
        if session is None:
            problem = (
                "This link was used before or is too old. Sign in with your key, or restart the server for a new one."
            )
            return _page("sign_in.html", None, status=401, problem=problem, next="/")
        return _signed_in(request, session, seconds, "/")
    if await _sessions(request).find(request) is not None:
        return RedirectResponse(_return(next_), 303)
    return _page("sign_in.html", None, problem="", next=_return(next_))


@router.post("/sign-in")
async def sign_in(request: Request, service: TheService) -> Response:
    """A session for whoever has a key."""
    check_same_origin(request.headers)
    form = parse_qs((await request.body()).decode(errors="replace"))
    following = _return(form.get("next", ["/"])[0])
    authenticator = cast(Authenticator, request.app.state.authenticator)
    key = form.get("key", [""])[0].strip()
    try:
        caller = await authenticator.caller(f"Bearer {key}", request.client.host if request.client else "")
    except ApiError as error:
        problem = "This key is unknown, revoked or expired." if error.status == 401 else str(error)
        return _page("sign_in.html", None, status=error.status, problem=problem, next=following)
    seconds = service.settings.session_seconds
    session = await run_in_threadpool(service.store.sessions.begin, caller.key_id, seconds)
    return _signed_in(request, session, seconds, following)


@router.post("/sign-out")
async def sign_out(request: Request) -> Response:
    """End the session, here and on the server."""
    check_same_origin(request.headers)
    await _sessions(request).end(request)
    response = RedirectResponse("/sign-in", 303)
    response.delete_cookie(cookie_name(request.headers), httponly=True, samesite="strict")
    return response


@router.get("/static/{version}/{name:path}")
async def static(version: str, name: str, request: Request) -> Response:
    """A script, a style, a picture."""
    found = static_files.static_answer(request, version, name)
    return found or Response(f"there is no {name}", 404, media_type="text/plain")


def _sessions(request: Request) -> BrowserSessions:
    return cast(BrowserSessions, request.app.state.browser_sessions)


async def _reader(request: Request) -> Caller:
    return await _with_scope(request, "read", "it can send scans, but not look at jobs")


async def _admin(request: Request) -> Caller:
    return await _with_scope(request, "admin", "it sees your own jobs, and not the whole fleet")


async def _with_scope(request: Request, scope: str, otherwise: str) -> Caller:
    caller = await _sessions(request).find(request)
    if caller is None:
        raise SignInFirst
    if scope not in caller.scopes:
        raise ApiError(ErrorCode.forbidden, f"your key lacks the scope '{scope}': {otherwise}")
    return caller


def _page(template: str, caller: Caller | None, policy: str = POLICY, *, status: int = 200, **values: Any) -> Response:
    here = template.removesuffix(".html")
    values = {"data": None, "words": _WORDS, "static": f"/static/{static_files.version()}", "caller": caller, **values}
    html = templates.get_template(template).render(here=here, status=status, **values)
    return HTMLResponse(html, status, {"Content-Security-Policy": policy, "Cache-Control": "no-store"})


def _signed_in(request: Request, session: str, seconds: float, following: str) -> Response:
    response = RedirectResponse(following, 303)
    response.set_cookie(
        cookie_name(request.headers),
        session,
        max_age=int(seconds),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


def _return(address: str) -> str:
    """Where to go after signing in: a page of this server, whatever the link said."""
    return address if _RETURN.fullmatch(address) else "/"
