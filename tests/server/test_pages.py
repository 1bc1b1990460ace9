"""The web page as HTTP has it: sessions, what other sites cannot do, headers, what browsers keep, and budgets."""

from __future__ import annotations

import gzip
import hashlib
import json
import re
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

import advtex_viewer
from advtex_contract.errors import JOB_EXPLANATIONS, ErrorCode
from advtex_contract.jobs import RETRYABLE, STATES, TERMINAL, JobError
from advtex_contract.stages import STAGE_LABELS
from advtex_server import static_files
from advtex_server.authentication import KNOWN_SECONDS
from advtex_server.browsers import HEADERS
from advtex_store.models import JobRow

pytestmark = pytest.mark.one_machine("the page asks what tests/store has on both databases")
FIRST_PAGE_BYTES = 100_000
FIRST_BYTE_SECONDS = 0.3
JOBS = 1000


def origin(live: Any) -> dict[str, str]:
    return {"Origin": live.url}


@pytest.fixture
def live(shared_live: Any) -> Any:
    shared_live.become(secrets.token_hex(4))
    return shared_live


@pytest.fixture
def browser(live: Any) -> Iterator[httpx.Client]:
    """Signed in with the key of `live`."""
    with live.client(None) as http:
        signed_in = http.post("/sign-in", data={"key": live.key}, headers=origin(live))
        assert (signed_in.status_code, signed_in.headers["location"]) == (303, "/")
        yield http


def data_of(response: httpx.Response) -> Any:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', response.text, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def test_whoever_is_not_signed_in_is_asked_to(live: Any) -> None:
    with live.client(None) as http:
        for path in ("/", "/new", "/jobs/x", "/?state=failed"):
            asked = http.get(path)
            assert asked.status_code == 303
            assert asked.headers["location"].startswith("/sign-in?next=/")
        assert http.get("/changes").status_code == 401
        assert 'type="password"' in http.get("/sign-in").text


def test_the_session_is_a_private_cookie(live: Any) -> None:
    with live.client(None) as http:
        answer = http.post("/sign-in", data={"key": live.key, "next": "/new"}, headers=origin(live))
        assert answer.headers["location"] == "/new"
        cookie = answer.headers["set-cookie"].lower()
        assert all(part in cookie for part in ("httponly", "samesite=strict", "path=/", "max-age=604800"))
        assert live.key not in cookie
        assert "secure" not in cookie
        https = {"X-Forwarded-Proto": "https", "Sec-Fetch-Site": "same-origin"}
        assert "secure" in http.post("/sign-in", data={"key": live.key}, headers=https).headers["set-cookie"].lower()


@pytest.mark.parametrize(
    "elsewhere", ["//evil.example", "https://evil.example/", "/\\evil.example", "javascript:alert(1)"]
)
def test_signing_in_leads_nowhere_else(live: Any, elsewhere: str) -> None:
    with live.client(None) as http:
        answer = http.post("/sign-in", data={"key": live.key, "next": elsewhere}, headers=origin(live))
        assert answer.headers["location"] == "/"


def test_a_wrong_key_is_told_and_guessing_ends(make_live: Callable[..., Any]) -> None:
    live = make_live(auth_failures_per_minute=2)
    with live.client(None) as http:
        answers = [http.post("/sign-in", data={"key": "adv_wrong"}, headers=origin(live)) for _ in range(3)]
        assert [answer.status_code for answer in answers] == [401, 401, 429]
        assert "unknown, revoked or expired" in answers[0].text
        assert "set-cookie" not in answers[0].headers


def test_the_api_takes_the_session_as_it_takes_the_key(live: Any, browser: httpx.Client, scan_zip: Path) -> None:
    assert browser.get("/v1/key").json()["id"] == live.key.split("_")[1]
    upload = browser.post("/v1/uploads", content=scan_zip.read_bytes(), headers=origin(live)).json()["id"]
    job = browser.post("/v1/jobs", json={"upload_id": upload}, headers=origin(live))
    assert job.status_code == 201
    assert live.http.get(f"/v1/jobs/{job.json()['id']}").status_code == 200
    with live.client("adv_000000000000_" + "a" * 40) as stranger:
        stranger.cookies = browser.cookies
        assert stranger.get("/v1/key").status_code == 401, "a key that is sent counts, and it alone"


@pytest.mark.parametrize(
    "sent",
    [
        {},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "same-site"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "none"},
    ],
)
def test_other_sites_change_nothing(live: Any, browser: httpx.Client, is_error: Any, sent: dict[str, str]) -> None:
    upload = live.upload()
    is_error(browser.delete(f"/v1/uploads/{upload}", headers=sent), 403, "forbidden")
    assert browser.post("/sign-out", headers=sent).status_code == 403
    assert browser.post("/sign-in", data={"key": live.key}, headers=sent).status_code == 403
    assert browser.get(f"/v1/uploads/{upload}").status_code == 200
    good = origin(live) if "Origin" in sent or not sent else {"Sec-Fetch-Site": "same-origin"}
    assert browser.delete(f"/v1/uploads/{upload}", headers=good).status_code == 204


def test_a_session_ends_by_signing_out_and_with_its_key(live: Any, browser: httpx.Client, is_error: Any) -> None:
    token = dict(browser.cookies)
    assert browser.post("/sign-out", headers=origin(live)).headers["location"] == "/sign-in"
    with live.client(None) as again:
        again.cookies.update(token)
        is_error(again.get("/v1/key"), 401, "unauthorized")
        again.post("/sign-in", data={"key": live.key}, headers=origin(live))
        assert again.get("/v1/key").status_code == 200
        live.store.accounts.revoke_key(live.key.split("_")[1])
        time.sleep(KNOWN_SECONDS + 0.1)
        is_error(again.get("/v1/key"), 401, "unauthorized")
        assert again.get("/").status_code == 303


def test_a_session_ends_at_its_time(make_live: Callable[..., Any], is_error: Any) -> None:
    live = make_live(session_seconds=0.001)
    with live.client(None) as http:
        cookie = http.post("/sign-in", data={"key": live.key}, headers=origin(live)).headers["set-cookie"].split(";")[0]
        is_error(http.get("/v1/jobs", headers={"Cookie": cookie}), 401, "unauthorized")


def test_a_key_may_do_in_a_browser_what_it_may_do_elsewhere(live: Any, is_error: Any) -> None:
    keys = live.store.accounts
    for scope, status in (("read", 200), ("write", 403)):
        with live.client(None) as http:
            key = keys.create_key(scope, owner="me", scopes=[scope])
            http.post("/sign-in", data={"key": key}, headers=origin(live))
            page = http.get("/")
            assert page.status_code == status
            assert 'href="/new"' not in page.text
    with live.client(None) as http:
        http.post("/sign-in", data={"key": keys.create_key("other", owner="other")}, headers=origin(live))
        job = live.job(live.upload())["id"]
        assert http.get(f"/jobs/{job}").status_code == 404


def test_every_answer_is_guarded_and_pages_run_their_own_scripts_only(live: Any, browser: httpx.Client) -> None:
    job = live.job(live.upload())["id"]
    for path in ("/", "/new", f"/jobs/{job}", "/jobs/none", "/sign-in", "/v1/jobs", "/healthz", "/nowhere"):
        answer = browser.get(path)
        for name, value in HEADERS.items():
            if name != "Content-Security-Policy":
                assert answer.headers[name] == value, (path, name)
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy
        assert not re.search(r"script-src[^;]*('unsafe-inline'|'unsafe-eval'|https?:)", policy)
        if "text/html" in answer.headers.get("content-type", ""):
            assert "no-store" in answer.headers["cache-control"]
            scripts = re.findall(r"<script(?![^>]*application/json)[^>]*>", answer.text)
            assert all(' src="/static/' in script for script in scripts), "no inline script"
            assert not re.search(r"\son\w+=|https?://(?!www\.w3\.org)", answer.text), "no handler, no other host"


def test_what_goes_wrong_is_told_in_a_page(make_live: Callable[..., Any]) -> None:
    live = make_live()
    with live.client(None) as http:
        http.post("/sign-in", data={"key": live.key}, headers=origin(live))
        missing = http.get("/jobs/none")
        assert (missing.status_code, "Nothing here" in missing.text) == (404, True)
        assert http.get("/?cursor=%00").status_code == 422
        with live.store.database.engine.begin() as connection:
            connection.exec_driver_sql("alter table jobs rename to gone")
        broken = http.get("/")
        assert broken.status_code == 503
        assert "<h1>This is not possible</h1>" in broken.text
        assert "the database cannot be reached" in broken.text


def test_hostile_names_are_text(live: Any, browser: httpx.Client) -> None:
    label = "</script><script>alert(1)</script><img src=x onerror=alert(1)>'\""
    job = live.job(live.upload(), label=label, batch="b")["id"]
    for path in (
        "/",
        f"/jobs/{job}",
        "/?label=%3Cscript%3E%22",
        "/sign-in?next=%22%3E%3Cscript%3E",
        "/jobs/%3Cscript%3E",
    ):
        text = browser.get(path).text
        assert "<script>" not in text
        assert "<img src=x" not in text
    found = next(found for found in data_of(browser.get("/"))["jobs"] if found["id"] == job)
    assert found["label"] == label


def test_lists_are_filtered_and_paged(live: Any, browser: httpx.Client) -> None:
    upload = live.upload()
    jobs = [live.job(upload, label=f"Kitchen {n}", batch="night" if n % 2 else "day")["id"] for n in range(35)]
    first = browser.get("/")
    assert [job["id"] for job in data_of(first)["jobs"]] == jobs[:4:-1]
    cursor = re.search(r'data-cursor="(\w+)"', first.text)
    assert cursor is not None
    rest = browser.get("/", params={"cursor": cursor[1]})
    assert [job["id"] for job in data_of(rest)["jobs"]] == jobs[4::-1]
    assert "data-cursor" not in rest.text
    some = data_of(browser.get("/", params={"label": "kitchen 3", "batch": "night", "state": "rejected"}))["jobs"]
    assert [job["label"] for job in some] == ["Kitchen 33", "Kitchen 31", "Kitchen 3"]
    assert data_of(browser.get("/", params={"label": "100%"}))["jobs"] == []
    assert {batch["id"]: batch["jobs"] for batch in data_of(first)["batches"]} == {"night": 17, "day": 18}


def test_a_job_whose_method_is_known_elsewhere_only_is_shown(live: Any, browser: httpx.Client) -> None:
    job = live.job(live.upload())["id"]
    with live.store.database.write() as session:
        row = session.get(JobRow, job)
        row.options = row.options | {"method": "from_elsewhere"}
    (listed,) = data_of(browser.get("/"))["jobs"]
    (told,) = live.http.get("/v1/jobs").json()["jobs"]
    assert listed["method"] == told["options"]["method"] == "from_elsewhere"
    assert data_of(browser.get(f"/jobs/{job}"))["options"] == told["options"]


def test_the_words_of_states_and_stages_are_the_contracts(browser: httpx.Client) -> None:
    page = browser.get("/").text
    found = re.search(r'<script type="application/json" id="words">(.*?)</script>', page)
    assert found is not None
    words = json.loads(found[1])
    assert list(words["stages"].items()) == list(STAGE_LABELS.items()), "in their order"
    assert [state for state, told in words["states"].items() if told["terminal"]] == [
        s for s in STATES if s in TERMINAL
    ]
    assert {state for state, told in words["states"].items() if told["retryable"]} == RETRYABLE
    assert words["usual_method"] == "view_selection"
    for state, facts in STATES.items():
        assert words["states"][state]["label"] == facts.label
        assert f'<option value="{state}">{facts.label}</option>' in page
    sheet = re.search(r'href="([^"]*page.css)"', page)
    assert sheet is not None
    style = browser.get(sheet[1]).text
    for tone in {facts.tone for facts in STATES.values()} - {"plain"}:
        assert f".badge.{tone} " in style


def test_changes_are_streamed_and_replayed(live: Any, browser: httpx.Client) -> None:
    upload = live.upload()
    since = data_of(browser.get("/"))["since"]
    missed = live.job(upload, label="missed")["id"]
    with browser.stream("GET", f"/changes?after={since}") as stream:
        lines = stream.iter_lines()
        events = [json.loads(next(line for line in lines if line.startswith("data: "))[6:])]
        live.http.delete(f"/v1/jobs/{missed}")
        events.append(json.loads(next(line for line in lines if line.startswith("data: "))[6:]))
    assert [(event["id"], event["deleted"]) for event in events] == [(missed, False), (missed, True)]
    with browser.stream("GET", "/changes", headers={"Last-Event-ID": str(since)}) as stream:
        assert missed in next(line for line in stream.iter_lines() if line.startswith("data: "))


def test_files_are_kept_by_browsers_until_they_change(live: Any) -> None:
    address = f"/static/{static_files.version()}/page.css"
    with live.client(None) as http:
        packed = http.get(address, headers={"Accept-Encoding": "gzip"})
        assert packed.headers["content-encoding"] == "gzip"
        assert "immutable" in packed.headers["cache-control"]
        plain = http.get(address, headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        assert plain.text == packed.text
        etag = {"If-None-Match": packed.headers["etag"], "Accept-Encoding": "gzip"}
        assert http.get(address, headers=etag).status_code == 304
        assert http.get("/static/older/page.css").headers["cache-control"] == "no-cache"
        for name in ("nowhere.css", "%2e%2e/app.py", "vendor/VENDORED.md"):
            assert http.get(f"/static/{static_files.version()}/{name}").status_code == 404


def test_every_code_of_an_error_is_explained_where_its_body_says(live: Any) -> None:
    with live.client(None) as http:
        page = http.get("/errors").text
        refused = http.get("/v1/jobs").json()
    places = set(re.findall(r'<div id="([\w-]+)">', page))
    assert {f"job-{code}" for code in JOB_EXPLANATIONS} <= places
    assert {code.value for code in ErrorCode} <= places, "each is in the catalogue"
    assert refused["help"].removeprefix("/errors#") in places
    assert JobError(code="poison", message="").help.removeprefix("/errors#") in places
    assert JobError(code="of_another_package", message="").help == ""


def test_the_catalogue_has_all_that_a_job_can_end_with() -> None:
    root = Path(__file__).parents[2]
    sources = [
        path
        for room in ("server/advtex_server", "server/advtex_store", "worker/advtex_worker")
        for path in (root / room).rglob("*.py")
    ]
    told = {
        code for path in sources for code in re.findall(r'(?:JobError|FailedEvent)\(\s*code="(\w+)"', path.read_text())
    }
    assert {"poison", "scan_missing", "engine_error"} < told
    assert told <= set(JOB_EXPLANATIONS)


@pytest.mark.parametrize("folder", [static_files.FOLDER, advtex_viewer.FOLDER], ids=["page", "viewer"])
def test_vendored_files_are_what_the_list_says(folder: Path) -> None:
    folder = folder / "vendor"
    listed = dict(
        re.findall(r"^\| `([\w.-]+)` .* `([0-9a-f]{64})` \|$", (folder / "VENDORED.md").read_text(), re.MULTILINE)
    )
    assert listed == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
        if path.suffix in static_files.SUFFIXES
    }


def test_the_first_page_is_small_and_fast(live: Any, browser: httpx.Client) -> None:
    """With a thousand jobs in the list, and everything that the page loads, as it is sent."""
    upload = live.upload()
    live.job(upload)
    _multiply_jobs(live, JOBS)
    browser.get("/")
    seconds = []
    for _ in range(5):
        started = time.perf_counter()
        with browser.stream("GET", "/") as response:
            seconds.append(time.perf_counter() - started)
            response.read()
    assert len(data_of(response)["jobs"]) == 30
    assert min(seconds) < FIRST_BYTE_SECONDS, seconds
    for page in ("/", "/new"):
        text = browser.get(page).text
        names = set(re.findall(r'(?:src|href)="(/static/[^"]+)"', text))
        for script in [name for name in names if name.endswith(".js")]:
            names |= {f"{script.rpartition('/')[0]}/{found}" for found in _imports(browser.get(script).text)}
        sizes = {name: len(gzip.compress(browser.get(name).content, 6)) for name in names}
        assert len(text.encode()) + sum(sizes.values()) < FIRST_PAGE_BYTES, sizes


def _imports(script: str) -> list[str]:
    return re.findall(r'from "\./([\w.-]+)"', script)


def _multiply_jobs(live: Any, count: int) -> None:
    """Copies of the newest job."""
    from sqlalchemy import insert, select

    table = JobRow.__table__
    with live.store.database.write() as session:
        columns = [column for column in table.c if column.computed is None]
        row = dict(session.execute(select(*columns).order_by(table.c.id.desc())).mappings().first())
        session.execute(insert(table), [{**row, "id": f"{n:028x}", "label": f"job {n}"} for n in range(count)])
