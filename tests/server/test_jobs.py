"""Jobs over HTTP: what users can see and do."""

from __future__ import annotations

import asyncio
import hashlib
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from advtex_contract.jobs import JobError, JobPage, JobView, Progress
from advtex_server.events import FRESH_SECONDS, Lookout
from advtex_store.errors import RecordNotFound, StaleAttempt
from advtex_store.memory_estimate import needed_memory
from advtex_store.models import JobRow


def lasting(view: dict[str, Any]) -> dict[str, Any]:
    """A job's view without what the dispatcher may change at any time: why the job waits."""
    return {name: value for name, value in view.items() if name not in ("waiting_reason", "updated_at")}


def test_a_good_scan_is_queued(live: Any, scan_zip: Path) -> None:
    response = live.http.post(
        "/v1/jobs",
        json={"upload_id": live.upload(scan_zip.read_bytes()), "label": "chair", "options": {"preset": "preview"}},
    )
    assert response.status_code == 201
    job = JobView.model_validate_json(response.content)
    assert response.headers["location"] == f"/v1/jobs/{job.id}"
    assert (job.state, job.attempt, job.label, job.options.preset) == ("checking", 0, "chair", "preview")
    assert (job.waiting_reason, job.memory_bytes) == ("its scan is being checked", 0)
    queued = JobView.model_validate(live.checked(job.id))
    assert (queued.state, queued.attempt, queued.label, queued.options) == ("queued", 0, job.label, job.options)
    assert queued.memory_bytes == needed_memory(job.options, views=5, width=32, height=24)


def test_a_bad_scan_is_rejected_with_every_finding(live: Any, is_error: Any) -> None:
    job = JobView.model_validate(live.job(live.upload(b"not a zip")))
    assert job.state == "rejected"
    assert job.error is not None
    assert "not a zip" in job.error.message
    assert all(d.where and d.message and d.remedy for d in job.error.details)
    assert live.store.records.waiting(10) == []
    is_error(live.http.post(f"/v1/jobs/{job.id}/retry"), 409, "conflict")


def test_a_method_that_is_not_known_uses_no_idempotency_key_up(live: Any, is_error: Any) -> None:
    spec, key = {"upload_id": live.upload(), "options": {"method": "magic"}}, {"Idempotency-Key": "once"}
    refused = is_error(live.http.post("/v1/jobs", json=spec, headers=key), 422, "invalid_options")
    assert "choose one of adversarial, " in refused
    spec["options"] = {"method": "mean"}
    assert live.http.post("/v1/jobs", json=spec, headers=key).json()["options"]["method"] == "mean"


@pytest.mark.one_machine("pure validation")
def test_options_out_of_bounds(live: Any, is_error: Any) -> None:
    upload = live.upload()
    for options in ({"steps": 0}, {"preset": "fastest"}, {"wdith": 3}, {"width": 5000}):
        response = live.http.post("/v1/jobs", json={"upload_id": upload, "options": options})
        message = is_error(response, 422, "invalid_options")
        assert next(iter(options)) in message
        assert response.json()["details"][0]["where"].startswith("body.options.")
    is_error(live.http.post("/v1/jobs", json={"upload_id": upload, "labels": "x"}), 422, "bad_request")
    is_error(live.http.post("/v1/jobs", content=b"{"), 422, "bad_request")
    is_error(live.http.post("/v1/jobs", json={"upload_id": "none"}), 404, "not_found")


def test_the_same_idempotency_key_gives_the_same_job(live: Any, scan_zip: Path, is_error: Any) -> None:
    upload = live.upload(scan_zip.read_bytes())
    job = live.job(upload, "key")
    again = live.http.post("/v1/jobs", json={"upload_id": upload}, headers={"Idempotency-Key": "key"})
    assert (again.status_code, again.json()["id"]) == (200, job["id"])
    other = live.http.post("/v1/jobs", json={"upload_id": upload, "label": "x"}, headers={"Idempotency-Key": "key"})
    is_error(other, 422, "idempotency_mismatch")
    live.http.post(f"/v1/jobs/{job['id']}/cancel")
    live.http.delete(f"/v1/jobs/{job['id']}")
    gone = live.http.post("/v1/jobs", json={"upload_id": upload}, headers={"Idempotency-Key": "key"})
    is_error(gone, 409, "conflict")


def test_a_key_in_flight_is_a_conflict(
    live: Any, scan_zip: Path, is_error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload = live.upload(scan_zip.read_bytes())
    looking, go_on = threading.Event(), threading.Event()
    service = live.app.state.service
    original = service._look

    def slow(*args: Any) -> Any:
        looking.set()
        assert go_on.wait(10)
        return original(*args)

    monkeypatch.setattr(service, "_look", slow)
    jobs: list[dict[str, Any]] = []
    first = threading.Thread(target=lambda: jobs.append(live.job(upload, "key")))
    first.start()
    assert looking.wait(10)
    response = live.http.post("/v1/jobs", json={"upload_id": upload}, headers={"Idempotency-Key": "key"})
    go_on.set()
    first.join()
    is_error(response, 409, "idempotency_in_flight")
    assert response.headers["retry-after"] == "1"
    assert [lasting(job) for job in live.http.get("/v1/jobs").json()["jobs"]] == [lasting(job) for job in jobs]


def test_a_refused_request_frees_its_key(live: Any, scan_zip: Path, is_error: Any) -> None:
    headers = {"Idempotency-Key": "key"}
    is_error(live.http.post("/v1/jobs", json={"upload_id": "none"}, headers=headers), 404, "not_found")
    assert live.job(live.upload(scan_zip.read_bytes()), "key")["state"] == "queued"


def test_lists(live: Any, scan_zip: Path, is_error: Any) -> None:
    upload = live.upload(scan_zip.read_bytes())
    made = [live.job(upload, label=f"label {n % 2}")["id"] for n in range(5)]
    live.http.post(f"/v1/jobs/{made[0]}/cancel")
    page = JobPage.model_validate_json(live.http.get("/v1/jobs", params={"limit": 3}).content)
    assert [job.id for job in page.jobs] == made[:1:-1]
    page = JobPage.model_validate_json(live.http.get("/v1/jobs", params={"cursor": page.next_cursor}).content)
    assert [job.id for job in page.jobs] == [made[1], made[0]]
    assert page.next_cursor is None

    def ids(**params: str) -> list[str]:
        return [job["id"] for job in live.http.get("/v1/jobs", params=params).json()["jobs"]]

    assert ids(state="canceled") == [made[0]]
    assert ids(label="label 1") == [made[3], made[1]]
    for params in ({"limit": 0}, {"limit": 1000}, {"cursor": "/"}, {"state": "none"}):
        is_error(live.http.get("/v1/jobs", params=params), 422, "bad_request")


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_other_owners_find_nothing(live: Any, scan_zip: Path, is_error: Any, tmp_path: Path) -> None:
    (tmp_path / "model.glb").write_bytes(b"glb")
    job = live.finished_job(scan_zip, {"model.glb": tmp_path / "model.glb"})
    with live.client(live.store.accounts.create_key("other")) as other:
        assert other.get("/v1/jobs").json()["jobs"] == []
        for method, path in [
            ("GET", ""),
            ("POST", "/cancel"),
            ("POST", "/retry"),
            ("DELETE", ""),
            ("GET", "/events"),
            ("GET", "/results/model.glb"),
        ]:
            is_error(other.request(method, f"/v1/jobs/{job}{path}"), 404, "not_found")
    with live.client(None) as stranger:
        response = stranger.get(f"/v1/jobs/{job}")
        is_error(response, 401, "unauthorized")
        assert response.headers["www-authenticate"].startswith("Bearer")
    with live.client(live.store.accounts.create_key(owner="me", scopes=["read"])) as reader:
        assert reader.get(f"/v1/jobs/{job}").status_code == 200
        is_error(reader.delete(f"/v1/jobs/{job}"), 403, "forbidden")


def test_cancel_retry_delete(live: Any, scan_zip: Path, is_error: Any) -> None:
    job = f"/v1/jobs/{live.job(live.upload(scan_zip.read_bytes()))['id']}"
    job_id = job.rpartition("/")[2]
    is_error(live.http.post(f"{job}/retry"), 409, "conflict")
    is_error(live.http.delete(job), 409, "conflict")
    live.store.records.claim(job_id, 1, "w")
    assert live.http.post(f"{job}/cancel").json()["state"] == "running"
    assert live.store.records.heartbeat(job_id, 1).cancel_requested
    live.store.records.canceled(job_id, 1)
    assert live.http.get(job).json()["state"] == "canceled"
    retried = live.http.post(f"{job}/retry").json()
    assert (retried["state"], retried["attempt"]) == ("queued", 1)
    live.store.records.claim(job_id, 2, "w")
    live.store.records.fail(job_id, 2, JobError(code="engine", message="it broke", log_tail="last words"))
    assert live.http.get(job).json()["error"]["log_tail"] == "last words"
    assert live.http.delete(job).status_code == 204
    is_error(live.http.get(job), 404, "not_found")


def events(text: str) -> list[tuple[int, str, dict[str, Any]]]:
    found = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return found


def test_events_follow_a_job_and_replay(live: Any, scan_zip: Path) -> None:
    job_id = live.job(live.upload(scan_zip.read_bytes()))["id"]
    records = live.store.records
    seen: list[str] = []
    with live.http.stream("GET", f"/v1/jobs/{job_id}/events") as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = response.iter_lines()
        for line in lines:
            seen.append(line)
            if line.startswith("data:") and '"state":"queued"' in line:
                records.claim(job_id, 1, "w")
            if line.startswith("data:") and '"state":"running"' in line and not any("optimization" in s for s in seen):
                records.heartbeat(job_id, 1, Progress(stage="optimization", step=1, steps=2))
            if line.startswith("data:") and '"stage":"optimization"' in line and '"state":"running"' in line:
                records.succeed(job_id, 1, [])
    told = events("\n".join(seen))
    ids = [number for number, _, _ in told]
    assert ids == sorted(ids)
    views = [JobView.model_validate(data) for _, name, data in told if name == "job"]
    assert [view.state for view in views] == ["queued", "running", "running", "succeeded"]
    assert views[2].progress.steps == 2
    states = [data.get("state") or data["stage"] for _, name, data in told if name != "job"]
    assert states == ["checking", "queued", "running", "optimization", "succeeded"]

    running = next(number for number, name, data in told if name == "state" and data["state"] == "running")
    replayed = live.http.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": str(running)})
    assert [name for _, name, _ in events(replayed.text)] == ["progress", "state", "job"]
    for odd in ("", "x", "-1", "9" * 30):
        end = events(live.http.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": odd}).text)[-1]
        assert (end[1], end[2]["state"]) == ("job", "succeeded")


def test_open_event_streams_do_not_hold_the_server(live: Any, scan_zip: Path) -> None:
    job_id = live.job(live.upload(scan_zip.read_bytes()))["id"]
    with live.http.stream("GET", f"/v1/jobs/{job_id}/events") as response:
        chunks = response.iter_raw()
        assert b'"queued"' in next(chunks)
        live.app.state.stopping.set()
        assert b'"running"' not in b"".join(chunks)


@pytest.fixture
def result(live: Any, scan_zip: Path, tmp_path: Path) -> tuple[str, bytes]:
    data = bytes(range(256)) * 10_000
    (tmp_path / "model.glb").write_bytes(data)
    job = live.finished_job(scan_zip, {"model.glb": tmp_path / "model.glb"})
    return f"/v1/jobs/{job}/results/model.glb", data


def test_a_result(live: Any, result: tuple[str, bytes], is_error: Any) -> None:
    url, data = result
    job = live.http.get(url.partition("/results")[0]).json()
    (file,) = job["results"]
    sha256 = hashlib.sha256(data).hexdigest()
    assert file == {
        "name": "model.glb",
        "size": len(data),
        "sha256": sha256,
        "content_type": "model/gltf-binary",
        "kind": "glb",
        "purpose": "for viewers and game engines: all faces and texels in one file",
        "url": url,
    }
    response = live.http.get(url)
    assert response.content == data
    assert response.headers["etag"] == f'"{sha256}"'
    assert response.headers["x-content-sha256"] == sha256
    assert response.headers["content-type"] == "model/gltf-binary"
    assert response.headers["content-disposition"] == 'attachment; filename="model.glb"'
    assert response.headers["accept-ranges"] == "bytes"
    unchanged = live.http.get(url, headers={"If-None-Match": f'"x", W/"{sha256}"'})
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    for name in ("none", "../../../etc/passwd", "..%2f..%2fresult.json", "%00"):
        is_error(live.http.get(url.replace("model.glb", name)), 404, "not_found")


@pytest.mark.one_machine("tests/store cuts blobs of both storages")
@pytest.mark.parametrize(
    ("header", "start", "end"),
    [
        ("bytes=0-9", 0, 10),
        ("bytes=100-", 100, None),
        ("bytes=-7", -7, None),
        ("bytes=2559999-99999999", 2559999, None),
        ("bytes=-99999999", 0, None),
    ],
)
def test_ranges(live: Any, result: tuple[str, bytes], header: str, start: int, end: int | None) -> None:
    url, data = result
    response = live.http.get(url, headers={"Range": header})
    expected = data[start:end]
    assert (response.status_code, response.content) == (206, expected)
    first = start if start >= 0 else len(data) + start
    assert response.headers["content-range"] == f"bytes {first}-{first + len(expected) - 1}/{len(data)}"
    assert response.headers["content-length"] == str(len(expected))


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize("header", ["bytes=5-2", "bytes=-", "bytes=a-b", "items=0-1", "bytes=0-1,3-4", "bytes=²-3"])
def test_ranges_that_are_ignored(live: Any, result: tuple[str, bytes], header: str) -> None:
    url, data = result
    response = live.http.get(url, headers={"Range": header.encode()})
    assert (response.status_code, len(response.content)) == (200, len(data))


@pytest.mark.one_machine("pure validation")
@pytest.mark.parametrize("header", ["bytes=2560000-", "bytes=99999999-100000000", "bytes=-0"])
def test_ranges_beyond_the_end(live: Any, result: tuple[str, bytes], header: str, is_error: Any) -> None:
    response = live.http.get(result[0], headers={"Range": header})
    is_error(response, 416, "bad_request")
    assert response.headers["content-range"] == "bytes */2560000"


def test_if_range(live: Any, result: tuple[str, bytes]) -> None:
    url, data = result
    etag = live.http.get(url, headers={"Range": "bytes=0-0"}).headers["etag"]
    same = live.http.get(url, headers={"Range": "bytes=5-9", "If-Range": etag})
    assert (same.status_code, same.content) == (206, data[5:10])
    changed = live.http.get(url, headers={"Range": "bytes=5-9", "If-Range": '"other"'})
    assert (changed.status_code, changed.content) == (200, data)


@pytest.mark.one_machine("tests/store has links on both databases")
def test_a_link_gives_one_file_to_whoever_has_it(live: Any, result: tuple[str, bytes], is_error: Any) -> None:
    url, data = result
    made = live.http.post(url.replace("/results/", "/links/"))
    assert made.status_code == 201
    link = made.json()["url"]
    with live.client(None) as anybody, live.client(live.store.accounts.create_key("other")) as other:
        assert anybody.get(link).content == data
        part = anybody.get(link, headers={"Range": "bytes=1-3"})
        assert (part.status_code, part.content, part.headers["content-type"]) == (206, data[1:4], "model/gltf-binary")
        is_error(anybody.get(url), 401, "unauthorized")
        for wrong in (
            link.replace("model.glb", "report.json"),
            link[:8] + "x" + link[9:],
            link.replace("/links/", "/links/."),
        ):
            is_error(anybody.get(wrong), 404, "not_found")
        is_error(anybody.post(url.replace("/results/", "/links/")), 401, "unauthorized")
        is_error(other.post(url.replace("/results/", "/links/")), 404, "not_found")
        is_error(live.http.post(url.replace("/results/model", "/links/no")), 404, "not_found")
        assert live.http.delete(url.partition("/results")[0]).status_code == 204
        is_error(anybody.get(link), 404, "not_found")


def test_results_of_an_unfinished_job(live: Any, scan_zip: Path, is_error: Any) -> None:
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    is_error(live.http.get(f"/v1/jobs/{job}/results/model.glb"), 409, "not_ready")


def test_deleting_a_job_removes_its_blobs(live: Any, result: tuple[str, bytes], is_error: Any) -> None:
    job = result[0].split("/")[3]
    assert list(live.store.blobs.list(f"jobs/{job}/"))
    assert live.http.delete(f"/v1/jobs/{job}").status_code == 204
    is_error(live.http.get(result[0]), 404, "not_found")
    deadline = threading.Event()
    for _ in range(300):
        if not list(live.store.blobs.list(f"jobs/{job}/")):
            break
        deadline.wait(0.02)
    assert not list(live.store.blobs.list(f"jobs/{job}/"))


def test_a_worker_that_lost_its_job_cannot_bring_it_back(make_live: Callable[..., Any], scan_zip: Path) -> None:
    live = make_live(lease_seconds=0.3)
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    live.store.records.claim(job, 1, "w")
    pause = threading.Event()
    for _ in range(300):
        if live.http.get(f"/v1/jobs/{job}").json()["state"] == "queued":
            break
        pause.wait(0.02)
    with pytest.raises(StaleAttempt):
        live.store.records.heartbeat(job, 1)
    assert live.http.get(f"/v1/jobs/{job}").json()["attempt"] == 1


def test_many_callers_at_once(live: Any, scan_zip: Path) -> None:
    upload = live.upload(scan_zip.read_bytes())
    answers: list[int] = []

    def call(number: int) -> None:
        with live.client(live.key) as http:
            for n in range(4):
                answers.append(http.post("/v1/jobs", json={"upload_id": upload, "label": f"{number}-{n}"}).status_code)
                answers.append(http.get("/v1/jobs").status_code)

    threads = [threading.Thread(target=call, args=(n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [200] * 24 + [201] * 24
    assert len(live.http.get("/v1/jobs").json()["jobs"]) == 24


@pytest.mark.one_machine("the errors are made")
def test_streams_outlast_a_database_in_trouble(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = live.job(live.upload())["id"]
    read = live.store.records.job
    troubles = iter([None, OperationalError("", {}, Exception("away")), PoolTimeoutError("all connections are in use")])

    def troubled(*which: str) -> Any:
        if (trouble := next(troubles, None)) is not None:
            raise trouble
        return read(*which)

    monkeypatch.setattr(live.store.records, "job", troubled)
    assert '"rejected"' in live.http.get(f"/v1/jobs/{job_id}/events").text


@pytest.mark.one_machine("counts calls, whatever they read")
def test_streams_of_one_job_share_a_look(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = live.job(live.upload())["id"]
    reads: list[str] = []
    read = live.store.records.job

    def counted(job_id: str, owner: str) -> Any:
        reads.append(owner)
        return read(job_id, owner)

    monkeypatch.setattr(live.store.records, "job", counted)

    async def looks() -> None:
        lookout = Lookout(live.app.state.service)
        first = lookout.look("me", job_id)
        assert lookout.look("me", job_id) is first
        assert lookout.look("you", job_id) is not first
        row, message = await first.job
        assert row.id == job_id
        assert f'"id":"{job_id}"' in message
        assert first.events(0) is first.events(0)
        assert [event.version for event in await first.events(0)] == [1, row.version]
        with pytest.raises(RecordNotFound):
            await lookout.look("you", job_id).job
        first.at -= FRESH_SECONDS
        assert lookout.look("me", job_id) is not first
        await lookout.look("me", job_id).job

    asyncio.run(looks())
    assert sorted(reads) == ["me", "me", "you"]


def test_rows_of_a_newer_version_are_shown(live: Any) -> None:
    """While servers of two versions run side by side."""
    job = live.job(live.upload())["id"]
    more = {"from_the_future": 1}
    with live.store.database.write() as session:
        row = session.get(JobRow, job)
        row.options = row.options | more
        row.progress = row.progress | more
        row.warnings = [{"message": "m", **more}]
        row.error = {"code": "c", "message": "m", **more}
    shown = live.http.get(f"/v1/jobs/{job}")
    assert shown.status_code == 200
    assert "from_the_future" not in shown.text
    assert [warning["message"] for warning in shown.json()["warnings"]] == ["m"]
    assert live.http.get("/v1/jobs").status_code == 200


def test_words_that_only_a_newer_version_knows_are_shown(live: Any) -> None:
    """In the job, its events, lists, the batch and the page; and what cannot be done to it is a conflict."""
    job = live.job(live.upload(), batch="night")["id"]
    words = {"preset": "ultra", "method": "splats", "max_texture_size": 1 << 20}
    with live.store.database.write() as session:
        row = session.get(JobRow, job)
        row.state, row.options = "polishing", row.options | words
        row.progress = row.progress | {"stage": "polish"}
    shown = live.http.get(f"/v1/jobs/{job}").json()
    assert (shown["state"], shown["progress"]["stage"]) == ("polishing", "polish")
    assert words.items() <= shown["options"].items()
    assert live.http.get("/v1/jobs").json()["jobs"] == [shown]
    assert live.http.get("/v1/batches/night").json()["states"] == {"polishing": 1}
    assert live.http.get("/v1/batches").json()["batches"][0]["states"] == {"polishing": 1}
    with live.http.stream("GET", f"/v1/jobs/{job}/events") as events:
        assert any('"polishing"' in line and '"ultra"' in line for line in events.iter_lines())
    with live.client(None) as browser:
        browser.post("/sign-in", data={"key": live.key}, headers={"Origin": live.url})
        for path in ("/", f"/jobs/{job}"):
            page = browser.get(path)
            assert page.status_code == 200
            assert job in page.text
    assert live.http.get("/metrics").status_code == 200
    assert live.http.post(f"/v1/jobs/{job}/cancel").status_code == 409
    assert live.http.delete(f"/v1/jobs/{job}").status_code == 409
