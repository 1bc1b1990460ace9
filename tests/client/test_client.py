"""The SDK against a server in memory that misbehaves on order."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from pathlib import Path

import anyio
import httpx
import pytest
from fake_server import FakeServer, answers, breaks, cuts_off_after, refuses, view
from tiny_scan import write_zip

from advtex_client import (
    AsyncClient,
    AuthError,
    BusyError,
    Client,
    ClientError,
    ConflictError,
    InvalidRequestError,
    JobFailedError,
    NetworkError,
    NotFoundError,
    ScanRejectedError,
    ServerError,
    WaitTimeoutError,
)
from advtex_client._calls import Attempts
from advtex_client.uploads import packed
from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import JobError, JobState
from advtex_contract.options import JobOptions

URL = "http://server.test"


@pytest.fixture
def server() -> FakeServer:
    return FakeServer()


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(URL, "adv_key", transport=server.transport) as made:
        yield made


@pytest.mark.parametrize(
    ("status", "code", "kind"),
    [
        (400, ErrorCode.bad_request, InvalidRequestError),
        (401, ErrorCode.unauthorized, AuthError),
        (403, ErrorCode.forbidden, AuthError),
        (404, ErrorCode.not_found, NotFoundError),
        (409, ErrorCode.conflict, ConflictError),
        (413, ErrorCode.too_large, InvalidRequestError),
        (422, ErrorCode.invalid_options, InvalidRequestError),
        (422, ErrorCode.idempotency_mismatch, ConflictError),
        (507, ErrorCode.insufficient_storage, BusyError),
        (500, ErrorCode.internal, ServerError),
    ],
)
def test_every_error_body_becomes_its_exception(
    server: FakeServer, client: Client, status: int, code: ErrorCode, kind: type[ClientError]
) -> None:
    server.faults = [answers(status, code)]
    with pytest.raises(kind) as caught:
        client.get_job("j0")
    assert caught.value.code == code
    assert len(server.requests) == 1


def test_a_proxy_s_page_is_told_apart(server: FakeServer, client: Client) -> None:
    server.faults = [lambda _: httpx.Response(500, text="<h1>nginx</h1>")]
    with pytest.raises(ServerError, match="did not answer as advtex"):
        client.get_job("j0")
    server.faults = [lambda _: httpx.Response(200, text="<h1>captive portal</h1>")]
    with pytest.raises(ClientError, match="no JobView"):
        client.get_job("j0")


def test_the_key_travels_in_the_header_only(server: FakeServer, client: Client) -> None:
    with pytest.raises(NotFoundError):
        client.get_job("../../admin?x=1")
    (request,) = server.requests
    assert request.headers["Authorization"] == "Bearer adv_key"
    assert request.url.raw_path == b"/v1/jobs/..%2F..%2Fadmin%3Fx%3D1"


@pytest.mark.parametrize("fault", [refuses, breaks, answers(502), answers(503), answers(504), answers(429)])
def test_passing_trouble_is_outlived_where_repeating_is_safe(server: FakeServer, client: Client, fault: object) -> None:
    server.jobs["j0"] = view("j0")
    server.faults = [fault] * 3  # type: ignore[list-item]
    assert client.get_job("j0").id == "j0"
    assert len(server.requests) == 4


def test_a_retry_of_a_job_is_not_repeated_when_its_fate_is_unknown(server: FakeServer, client: Client) -> None:
    server.jobs["j0"] = view("j0")
    server.faults = [breaks]
    with pytest.raises(NetworkError):
        client.retry_job("j0")
    assert len(server.requests) == 1
    server.faults = [refuses, answers(503)]
    assert client.retry_job("j0").id == "j0", "what was never done may be asked for again"


def test_trouble_that_lasts_is_a_network_error_that_names_the_server(server: FakeServer, client: Client) -> None:
    server.faults = [refuses] * 5
    with pytest.raises(NetworkError, match=r"no answer from http://server\.test: connection refused"):
        client.get_job("j0")
    assert len(server.requests) == 5


def test_pauses_grow_are_spread_and_respect_what_the_server_asks() -> None:
    attempts = Attempts(True, 6)
    pauses = [attempts.after_error(httpx.ReadError("x")) for _ in range(6)]
    for number, pause in enumerate(pauses):
        full = min(15.0, 0.5 * 2**number)
        assert full / 2 <= pause <= full
    with pytest.raises(NetworkError):
        attempts.after_error(httpx.ReadError("x"))
    asked = Attempts(True, 1).after_response(httpx.Response(503, headers={"Retry-After": "20"}))
    assert asked == 20.0


def test_submit_sends_the_scan_once_and_makes_one_job(server: FakeServer, client: Client, scan: Path) -> None:
    sent: list[tuple[int, int]] = []
    job = client.submit(scan, JobOptions(seed=1), label="a", on_bytes=lambda done, total: sent.append((done, total)))
    assert sent[-1][0] == sent[-1][1] > 0
    assert client.submit(scan, JobOptions(seed=1), label="a").id == job.id
    assert len(server.uploads) == len(server.jobs) == 1


def test_other_options_or_labels_are_other_jobs_of_one_upload(server: FakeServer, client: Client, scan: Path) -> None:
    ids = [client.submit(scan, JobOptions(seed=seed), label=label).id for seed in (0, 1) for label in ("", "b")]
    assert len(set(ids)) == 4
    assert list(server.uploads) == ["u0"]
    assert server.received == server.uploads["u0"].size, "what the server holds is not sent again"


PIECE = 10_000


def test_a_line_that_breaks_again_and_again_costs_only_what_was_on_it(
    server: FakeServer, client: Client, scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_client.uploads.PIECE", PIECE)
    cuts = iter([5000, 0, 9999, 10_000, 0, 0, 0, 1, 0, 0, 0, 0, 7000])

    def handle(request: httpx.Request) -> httpx.Response:
        if request.method == "PATCH" and (cut := next(cuts, None)) is not None:
            request.read()
            return cuts_off_after(server, cut)(request)
        return server.handle(request)

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as broken:
        upload = broken.upload(scan)
    assert upload.complete
    assert server.received == upload.size
    with packed(scan) as archive:
        assert server.bytes[upload.id] == archive.path.read_bytes()
    assert max(len(request.content) for request in server.requests) <= PIECE


def test_a_line_that_never_comes_back_is_given_up_and_the_next_run_goes_on(
    server: FakeServer, scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_client.uploads.PIECE", PIECE)
    pieces = iter([None, None])

    def handle(request: httpx.Request) -> httpx.Response:
        if request.method == "PATCH" and next(pieces, 0) is not None:
            raise httpx.WriteError("connection reset", request=request)
        return server.handle(request)

    with (
        Client(URL, "k", retries=3, transport=httpx.MockTransport(handle)) as broken,
        pytest.raises(NetworkError, match="connection reset"),
    ):
        broken.submit(scan)
    assert server.received == 2 * PIECE
    with Client(URL, "k", transport=server.transport) as client:
        client.submit(scan)
    assert server.received == server.uploads["u0"].size
    assert list(server.uploads) == ["u0"]


def test_an_upload_whose_creation_was_never_answered_is_found(server: FakeServer, scan: Path) -> None:
    lost = iter([True])

    def handle(request: httpx.Request) -> httpx.Response:
        answer = server.handle(request)
        if request.method == "POST" and request.url.path == "/v1/uploads" and next(lost, False):
            raise httpx.ReadError("connection reset", request=request)
        return answer

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as client:
        assert client.upload(scan).id == "u0"
    assert list(server.uploads) == ["u0"]


def test_an_upload_that_vanished_is_begun_anew(server: FakeServer, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advtex_client.uploads.PIECE", PIECE)
    count = 0

    def handle(request: httpx.Request) -> httpx.Response:
        nonlocal count
        count += request.method == "PATCH"
        if request.method == "PATCH" and count == 3:
            server.uploads.clear()
        return server.handle(request)

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as client:
        upload = client.upload(scan)
    assert (upload.id, upload.complete) == ("u1", True)


def test_a_refusal_is_not_tried_again(server: FakeServer, client: Client, scan: Path) -> None:
    def handle(request: httpx.Request) -> httpx.Response:
        return answers(413, ErrorCode.quota_exceeded)(request) if request.method == "POST" else server.handle(request)

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as refused, pytest.raises(InvalidRequestError):
        refused.upload(scan)
    assert server.count("GET", "/v1/uploads") == 1


def test_the_async_client_goes_on_too(server: FakeServer, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advtex_client.uploads.PIECE", PIECE)
    cuts = iter([5000, 0])

    async def handle(request: httpx.Request) -> httpx.Response:
        if request.method == "PATCH" and (cut := next(cuts, None)) is not None:
            await request.aread()
            return cuts_off_after(server, cut)(request)
        await request.aread()
        return server.handle(request)

    async def upload() -> bool:
        async with AsyncClient(URL, "k", transport=httpx.MockTransport(handle)) as client:
            return (await client.upload(scan)).complete

    async def at_once(_seconds: float) -> None:
        return

    monkeypatch.setattr("advtex_client.async_client.anyio.sleep", at_once)
    assert anyio.run(upload)
    assert server.received == server.uploads["u0"].size


def test_an_async_submission_that_is_canceled_gives_its_locks_back(
    server: FakeServer, scan: Path, tmp_path: Path
) -> None:
    async def hangs(request: httpx.Request) -> httpx.Response:
        await request.aread()
        if request.method == "PATCH":
            await anyio.sleep_forever()
        return server.handle(request)

    async def main() -> None:
        transport = httpx.MockTransport(hangs)
        async with AsyncClient(URL, "k", transport=transport) as client, anyio.create_task_group() as tasks:
            tasks.start_soon(client.submit, scan)
            while not server.uploads:
                await anyio.sleep(0.01)
            tasks.cancel_scope.cancel()

    anyio.run(main)
    locks = list((tmp_path / "state").rglob("*.lock"))
    assert len(locks) == 2, "the submission's and the upload's"
    for lock in locks:
        with lock.open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_new_makes_another_job_from_the_same_upload(server: FakeServer, client: Client, scan: Path) -> None:
    first = client.submit(scan)
    second = client.submit(scan, new=True)
    assert first.id != second.id
    assert client.submit(scan).id == second.id
    assert len(server.uploads) == 1


@pytest.mark.parametrize("broken_at", [0, 1])
def test_a_submission_that_crashed_goes_on(server: FakeServer, scan: Path, broken_at: int) -> None:
    """A crash after 0: the upload, 1: the request for the job, whose answer never arrived."""

    def handle(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/v1/jobs":
            if broken_at == 1:
                server.handle(request)
            raise KeyboardInterrupt
        return server.handle(request)

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as client, pytest.raises(KeyboardInterrupt):
        client.submit(scan)
    with Client(URL, "k", transport=server.transport) as client:
        job = client.submit(scan)
    assert list(server.jobs) == [job.id]
    assert len(server.uploads) == 1


def test_a_job_that_was_deleted_is_made_again(server: FakeServer, client: Client, scan: Path) -> None:
    first = client.submit(scan)
    client.delete_job(first.id)
    server.uploads.clear()
    server.jobs["other"] = view("other")
    assert client.submit(scan).id != first.id
    assert len(server.uploads) == 1


def test_a_submission_that_this_computer_forgot_says_what_to_do(
    server: FakeServer, client: Client, scan: Path, tmp_path: Path
) -> None:
    job = client.submit(scan)
    for file in (tmp_path / "state").rglob("*.json"):
        file.write_text("not json")
    assert client.submit(scan).id == job.id, "the server knows the upload by its sha256, and the job by its key"
    for file in (tmp_path / "state").rglob("*.json"):
        file.write_text("not json")
    server.uploads.clear()
    with pytest.raises(ClientError, match="--new makes another one"):
        client.submit(scan)
    assert client.submit(scan, new=True).id == "j1"


def test_a_request_that_is_still_being_answered_is_asked_again(server: FakeServer, client: Client, scan: Path) -> None:
    with Client(URL, "k", transport=server.transport) as client:
        client.upload(scan)
    server.faults = []
    original = server.handle
    refused = iter([answers(409, ErrorCode.idempotency_in_flight)] * 2)

    def handle(request: httpx.Request) -> httpx.Response:
        fault = next(refused, None) if request.url.path == "/v1/jobs" else None
        return fault(request) if fault else original(request)

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as client:
        assert client.submit(scan).id == "j0"


def test_a_bad_scan_is_not_sent(server: FakeServer, client: Client, scan: Path) -> None:
    (scan / "scan.json").write_text("{")
    with pytest.raises(ScanRejectedError) as caught:
        client.submit(scan)
    assert caught.value.details[0].where == "scan.json"
    assert server.requests == []


def test_a_zip_is_sent_as_it_is(server: FakeServer, client: Client, scan: Path, tmp_path: Path) -> None:
    archive = write_zip(tmp_path / "my scan.zip", scan)
    client.submit(archive)
    assert server.bytes["u0"] == archive.read_bytes()
    assert server.uploads["u0"].filename == "my scan.zip"


STEPS = [
    view("j0", JobState.running, 1),
    view("j0", JobState.running, 1),
    view("j0", JobState.running, 2),
    view("j0", JobState.succeeded, 3),
]


@pytest.mark.parametrize("events", [True, False])
def test_watching_tells_every_change_once_by_events_or_by_polls(
    server: FakeServer, client: Client, events: bool
) -> None:
    server.jobs["j0"] = view("j0")
    server.script, server.events = list(STEPS), events
    seen = [(job.state, job.progress.step) for job in client.watch_job("j0")]
    assert seen[-3:] == [(JobState.running, 1), (JobState.running, 2), (JobState.succeeded, 3)]
    assert len(seen) == len(set(seen))


def test_trouble_while_watching_is_never_the_job_s(server: FakeServer, client: Client) -> None:
    server.jobs["j0"] = view("j0")
    server.script = list(STEPS)
    server.faults = [refuses, breaks, answers(500), answers(503), answers(429)]
    trouble: list[str] = []
    last = [job.state for job in client.watch_job("j0", on_trouble=lambda error: trouble.append(error.code))][-1]
    assert last is JobState.succeeded
    assert trouble == ["network", "network", "unavailable", "unavailable", "unavailable"]


@pytest.mark.parametrize(("status", "kind"), [(401, AuthError), (404, NotFoundError)])
def test_watching_ends_when_the_job_is_out_of_reach(
    server: FakeServer, client: Client, status: int, kind: type[ClientError]
) -> None:
    server.faults = [answers(status, ErrorCode.not_found)]
    with pytest.raises(kind):
        list(client.watch_job("j0"))


def test_watching_gives_up_at_its_timeout_and_says_that_the_job_goes_on(server: FakeServer, client: Client) -> None:
    server.jobs["j0"] = view("j0", JobState.running)
    with pytest.raises(WaitTimeoutError, match="it goes on") as caught:
        list(client.watch_job("j0", timeout=0.05))
    assert caught.value.job == server.jobs["j0"]


def test_a_line_that_stays_dead_is_given_up_in_the_end(
    server: FakeServer, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("advtex_client._events.PATIENCE_SECONDS", 0.0)
    server.faults = [refuses] * 3
    with pytest.raises(NetworkError, match="the job may go on"):
        list(client.watch_job("j0"))


@pytest.mark.parametrize(
    ("state", "kind", "words"),
    [
        (JobState.failed, JobFailedError, "failed: out of paint"),
        (JobState.rejected, ScanRejectedError, "rejected: out of paint"),
        (JobState.canceled, JobFailedError, "goes on from its checkpoint"),
    ],
)
def test_waiting_raises_how_the_job_ended(
    server: FakeServer, client: Client, state: JobState, kind: type[ClientError], words: str
) -> None:
    server.jobs["j0"] = view("j0", state, error=JobError(code="x", message="out of paint"))
    with pytest.raises(kind, match=words):
        client.wait_for_job("j0")


def test_pages_are_fetched_as_they_are_needed() -> None:
    asked: list[str | None] = []

    def handle(request: httpx.Request) -> httpx.Response:
        cursor = request.url.params.get("cursor")
        asked.append(cursor)
        number = int(cursor or 0)
        jobs = [view(f"j{number}").model_dump(mode="json")]
        return httpx.Response(200, json={"jobs": jobs, "next_cursor": str(number + 1) if number < 2 else None})

    with Client(URL, "k", transport=httpx.MockTransport(handle)) as client:
        pages = client.list_jobs()
        assert next(pages).id == "j0"
        assert asked == [None]
        assert [job.id for job in pages] == ["j1", "j2"]


def test_the_async_client_submits_watches_and_fetches(server: FakeServer, scan: Path, tmp_path: Path) -> None:
    async def main() -> None:
        async with AsyncClient(URL, "k", transport=server.transport) as client:
            server.faults = [answers(503)]
            job = await client.submit(scan)
            done = server.finish(job.id, {"model.obj": b"o" * 3_000_000})
            assert await client.wait_for_job(job.id) == done
            server.faults = [breaks]
            (path,) = await client.download_results(done, tmp_path / "out")
            assert path.read_bytes() == b"o" * 3_000_000
            assert (await client.submit(scan)).id == job.id
            await client.delete_job(job.id)
            with pytest.raises(NotFoundError):
                await client.get_job(job.id)

    anyio.run(main)


def test_the_public_names_are_sorted_and_exist() -> None:
    import advtex_client

    assert advtex_client.__all__ == sorted(advtex_client.__all__)
    assert all(hasattr(advtex_client, name) for name in advtex_client.__all__)
