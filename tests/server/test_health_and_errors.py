"""Health, metrics, and the one error body."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import update

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import Progress
from advtex_server.ranges import chosen_range
from advtex_server.refusal import STATUS
from advtex_store.models import JobRow


def test_every_code_has_a_status() -> None:
    assert set(STATUS) == set(ErrorCode)
    assert all(400 <= status < 600 for status in STATUS.values())


@pytest.mark.one_machine("pure validation")
def test_every_refusal_has_the_one_body(live: Any, is_error: Any) -> None:
    http = live.http
    is_error(http.get("/nowhere"), 404, "not_found")
    is_error(http.get("/v1/nowhere"), 404, "not_found")
    is_error(http.put("/v1/jobs"), 405, "bad_request")
    is_error(http.get("/v1/jobs/" + "a" * 65), 422, "bad_request")
    is_error(http.post("/v1/jobs", json=[]), 422, "bad_request")
    for header in ("", "Basic x", "Bearer", "Bearer x", "Bearer adv_000000000000_" + "a" * 40):
        is_error(http.get("/v1/jobs", headers={"Authorization": header}), 401, "unauthorized")
        is_error(http.get("/v1/nowhere", headers={"Authorization": header}), 401, "unauthorized")


@pytest.mark.one_machine("pure validation")
def test_bodies_are_small(make_live: Callable[..., Any], is_error: Any) -> None:
    live = make_live(max_body_bytes=1000)
    is_error(live.http.post("/v1/jobs", content=b" " * 1001), 413, "too_large")
    is_error(live.http.post("/v1/jobs", content=iter([b" " * 600] * 2)), 413, "too_large")


def test_odd_characters_are_no_failure(live: Any, is_error: Any) -> None:
    """PostgreSQL's text has no NUL."""
    for method, path in (
        ("GET", "/v1/jobs/%00"),
        ("GET", "/v1/jobs/%00/events"),
        ("GET", "/v1/jobs/%00/results/x"),
        ("DELETE", "/v1/jobs/%00"),
        ("POST", "/v1/jobs/%00/retry"),
        ("GET", "/v1/uploads/%00"),
        ("DELETE", "/v1/uploads/%00"),
        ("GET", "/v1/batches/%00"),
        ("POST", "/v1/batches/%00/cancel"),
        ("GET", "/v1/webhooks/%00"),
        ("GET", "/v1/jobs?label=%00"),
        ("GET", "/v1/jobs?batch=%00"),
    ):
        is_error(live.http.request(method, path), 422, "bad_request")
    for spec in ({"upload_id": "\0"}, {"upload_id": "x", "label": "\0"}, {"upload_id": "x", "batch": "\0"}):
        is_error(live.http.post("/v1/jobs", json=spec), 422, "bad_request")
    is_error(live.http.post("/v1/jobs", json={"source": "file:///%00"}), 422, "invalid_source")
    is_error(live.http.post("/v1/webhooks", json={"url": "https://1.1.1.1/\0"}), 422, "bad_request")
    upload = live.http.post("/v1/uploads", content=b"x", headers={"X-Filename": "a%00%F0%9F%AA%91b"})
    assert upload.json()["filename"] == "a\U0001fa91b"
    assert live.job(upload.json()["id"], label="\U0001fa91")["label"] == "\U0001fa91"


@pytest.mark.one_machine("pure validation")
def test_what_goes_wrong_inside_is_not_told(live: Any, is_error: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("secret")

    monkeypatch.setattr(live.store.records, "job", broken)
    assert "secret" not in is_error(live.http.get("/v1/jobs/x"), 500, "internal")


def test_health(live: Any, tmp_path: Path) -> None:
    with live.client(None) as stranger:
        assert stranger.get("/healthz").json() == {"status": "ok"}
        ready = stranger.get("/readyz")
    assert ready.status_code == 200, "without Redis, jobs are accepted and wait"
    checks = ready.json()["checks"]
    works = {name for name, check in checks.items() if check["ok"]} - {"background"}  # which may not have looked yet
    assert works == {"database", "blobs", "disk", "housekeeping"}
    assert "jobs are accepted and wait" in checks["redis"]["message"]


def spoil(live: Any) -> None:
    """Puts another file in the place of the database: SQLite maps its files, and cutting one short would kill us."""
    database = live.settings.data_dir / "advtex.db"
    (live.settings.data_dir / "other").write_bytes(b"no database any more" * 100)
    (live.settings.data_dir / "other").replace(database)
    for suffix in ("-wal", "-shm"):
        database.with_name(database.name + suffix).unlink(missing_ok=True)
    live.store.database.engine.dispose()  # after it, so that nobody goes on with the one before


@pytest.mark.one_machine("spoils the database's file")
def test_readyz_says_what_is_wrong(live: Any) -> None:
    settings = live.settings.model_copy(update={"disk_reserve_bytes": 1 << 60})
    live.app.state.service.settings = settings
    live.store.blobs.spool_dir.mkdir(parents=True, exist_ok=True)
    live.store.blobs.spool_dir.rmdir()
    live.store.blobs.spool_dir.write_text("in the way")
    spoil(live)
    response = live.http.get("/readyz")
    assert response.status_code == 503
    body = response.json()
    assert body["ready"] is False
    messages = {name: check["message"] for name, check in body["checks"].items()}
    assert "cannot be written" in messages["blobs"]
    assert "database does not answer" in messages["database"]
    assert messages["disk"]
    live.store.blobs.spool_dir.unlink()
    assert "make room" in live.http.get("/readyz").json()["checks"]["disk"]["message"]


@pytest.mark.one_machine("spoils the database's file")
def test_a_database_that_is_away_is_unavailable(live: Any, is_error: Any) -> None:
    spoil(live)
    response = live.http.get("/v1/jobs")
    is_error(response, 503, "unavailable")
    assert response.headers["retry-after"] == "5"
    is_error(live.http.post("/v1/uploads", content=b"x"), 503, "unavailable")


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_metrics(live: Any) -> None:
    live.job(live.upload())
    for number in range(3):
        live.http.get(f"/v1/jobs/{number}")
    with live.client(None) as stranger:
        text = stranger.get("/metrics").text
    samples = {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples["advtex_jobs", ("state", "rejected")] == 1
    assert samples["advtex_jobs", ("state", "queued")] == 0
    missed = ("advtex_http_requests_total", ("method", "GET"), ("route", "/v1/jobs/{job_id}"), ("status", "404"))
    assert samples[missed] == 3
    assert samples[("advtex_disk_free_bytes",)] > 0
    assert samples[("advtex_redis_up",)] == 0
    assert samples["advtex_jobs_ended_total", ("state", "rejected")] == 1
    assert samples["advtex_failures_total", ("cause", "invalid_scan")] == 1


def test_metrics_of_the_fleet(make_live: Callable[..., Any], redis_url: str, scan_zip: Path) -> None:
    live = make_live(redis_url=redis_url)
    upload = live.upload(scan_zip.read_bytes())
    jobs = [live.job(upload)["id"] for _ in range(3)]
    records = live.store.records
    records.claim(jobs[0], 1, "w")
    progress = Progress(stage="atlas", steps_per_second=2.5, stage_seconds={"ingest": 4.0}, losses={"accuracy": 0.5})
    records.heartbeat(jobs[0], 1, progress)
    records.claim(jobs[1], 1, "w")
    records.lost(jobs[1], 1)
    records.claim(jobs[1], 2, "w")
    records.preempt(jobs[1], 2)
    live.store.queue.announce("w", 8)
    told = live.http.get("/metrics").text.splitlines()
    assert "advtex_queue_depth 2.0" in told
    assert "advtex_steps_per_second 2.5" in told
    assert 'advtex_workers{gib="8"} 1.0' in told
    assert {f'advtex_attempts_ended_early_total{{how="{how}"}} 1.0' for how in ("lost", "preempted")} <= set(told)
    (age,) = [float(line.split()[1]) for line in told if line.startswith("advtex_queue_age_seconds ")]
    assert 0 < age < 60
    records.succeed(jobs[0], 1, [])
    told = live.http.get("/metrics").text.splitlines()
    assert 'advtex_stage_seconds_count{stage="ingest"} 1.0' in told
    assert 'advtex_stage_seconds_sum{stage="ingest"} 4.0' in told
    assert 'advtex_jobs_ended_total{state="succeeded"} 1.0' in told
    preset = records.job(jobs[0]).options["preset"]
    accuracy = f'advtex_discriminator_accuracy_bucket{{le="%s",preset="{preset}"}} %s'
    assert {accuracy % ("0.45", "0.0"), accuracy % ("0.55", "1.0"), accuracy % ("+Inf", "1.0")} <= set(told)


def test_jobs_that_wait_are_told_by_the_class_that_they_need(make_live: Callable[..., Any], scan_zip: Path) -> None:
    live = make_live()
    upload = live.upload(scan_zip.read_bytes())
    small = [live.job(upload)["id"] for _ in range(2)]
    large = live.job(upload)["id"]
    running = live.job(upload)["id"]
    with live.store.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == large).values(memory_bytes=(11 << 30) + 1))
    for job in (small[0], running):
        live.store.records.claim(job, 1, "w")
    live.store.records.preempt(small[0], 1)
    told = live.http.get("/metrics").text.splitlines()
    gib = live.store.records.job(small[0]).memory_gib
    assert f'advtex_jobs_waiting{{memory_gib="{gib}"}} 2.0' in told
    assert 'advtex_jobs_waiting{memory_gib="12"} 1.0' in told
    ages = [float(line.split()[1]) for line in told if line.startswith("advtex_jobs_waiting_oldest_seconds{")]
    assert len(ages) == 2
    assert 0 < min(ages) < max(ages) < 60


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_readyz_tells_of_workers_that_pause(make_live: Callable[..., Any], redis_url: str, scan_zip: Path) -> None:
    live = make_live(redis_url=redis_url)
    job = live.job(live.upload(scan_zip.read_bytes()))["id"]
    live.store.queue.announce("w", 8)
    live.store.records.claim(job, 1, "w")
    for reason in ("the disk of its worker is full", ""):
        live.store.records.heartbeat(job, 1, waiting_reason=reason)
        ready = live.http.get("/readyz")
        workers = ready.json()["checks"]["workers"]
        assert (ready.status_code, workers["ok"]) == (200, not reason)
        assert reason in workers["message"]
        assert live.http.get(f"/v1/jobs/{job}").json()["waiting_reason"] == reason


@pytest.mark.parametrize(
    ("header", "size", "span"),
    [
        ("bytes=0-0", 1, (0, 1)),
        ("bytes=0-", 5, (0, 5)),
        ("bytes=-5", 3, (0, 3)),
        ("bytes= 1-2 ", 3, (1, 3)),
        ("", 3, None),
    ],
)
def test_ranges_by_hand(header: str, size: int, span: tuple[int, int] | None) -> None:
    assert chosen_range(header, size) == span
