"""The fleet at a glance: what is told of it, in a terminal and on a page, and to whom."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from sqlalchemy import update

from advtex_contract.jobs import JobError, JobState, Progress
from advtex_server import fleet
from advtex_server.embedded import client_key
from advtex_server.fleet import HOURS, FleetView, look_at_fleet
from advtex_server.top import picture
from advtex_store.fleet import GpuReading, WorkerReport
from advtex_store.models import JobRow

GIB = 1 << 30
HOSTILE = "[bold]<b>ada</b>[/bold]"


@pytest.fixture
def busy(make_live: Callable[..., Any], redis_url: str, scan_zip: Path) -> Any:
    """Two owners, three workers, and of each kind of job one: `jobs` by what they do."""
    live = make_live(redis_url=redis_url)
    store, upload = live.store, live.upload(scan_zip.read_bytes())
    live.jobs = {
        name: live.job(upload, label=name)["id"] for name in ("runs", "old", "waits", "failed", "done", "poison")
    }
    for name in ("runs", "old", "failed", "done", "poison"):
        store.records.claim(live.jobs[name], 1, "w")
    progress = Progress(stage="optimization", step=30, steps=120, steps_per_second=2.5, eta_seconds=36.0)
    store.records.heartbeat(live.jobs["runs"], 1, progress)
    for name in ("failed", "poison"):
        store.records.fail(live.jobs[name], 1, JobError(code="engine_error", message=f"{name} {HOSTILE}"))
    store.records.succeed(live.jobs["done"], 1, [])
    live.become(HOSTILE)
    live.job(live.upload(scan_zip.read_bytes()))
    gpu = GpuReading(uuid="GPU-a", memory_used_bytes=3 * GIB, memory_bytes=24 * GIB, utilization=0.5)
    store.queue.announce("host-1", 24, busy=True)
    store.fleet.tell("host-1", WorkerReport(host="host", gpu=gpu, job=live.jobs["runs"], attempt=1, since=1.0))
    store.queue.announce("host-2", 24)
    store.queue.announce("older-3", 8, busy=True)
    with store.database.write() as session:
        session.execute(update(JobRow).where(JobRow.id == live.jobs["waits"]).values(memory_bytes=30 * GIB))
    return live


def test_what_is_told_of_a_fleet(busy: Any) -> None:
    view = look_at_fleet(busy.store)
    assert view.workers is not None
    assert [(found.name, found.memory_gib, found.busy) for found in view.workers] == [
        ("older-3", 8, True),
        ("host-1", 24, True),
        ("host-2", 24, False),
    ]
    work = view.workers[1].work
    assert work is not None
    assert (work.job, work.owner, work.stage, work.step, work.steps) == (
        busy.jobs["runs"],
        "me",
        "optimization",
        30,
        120,
    )
    assert [work.job for work in view.elsewhere] == [busy.jobs["old"]], "the older worker tells of no job"
    assert {line.owner: line.jobs for line in view.queue} == {"me": 1, HOSTILE: 1}
    assert view.queue[[line.owner for line in view.queue].index("me")].by_memory_gib == {30: 1}
    assert view.without_worker == 1
    assert len(view.hours) == HOURS
    ended = Counter[JobState]()
    for hour in view.hours[-2:]:  # an hour may have begun meanwhile
        ended.update(hour.states)
    assert ended == {JobState.failed: 2, JobState.succeeded: 1}
    (cause,) = view.failures
    assert (cause.cause, cause.jobs) == ("engine_error", 2)
    assert {job.id for job in cause.newest} == {busy.jobs["failed"], busy.jobs["poison"]}


@pytest.mark.one_machine("Redis is away")
def test_states_come_in_the_same_order_at_every_look() -> None:
    ended = [(0, "succeeded", 3), (1, "rejected", 1), (0, "failed", 1), (1, "canceled", 2)]
    told = [[list(hour.states.items()) for hour in fleet._hours(0.0, rows)] for rows in (ended, ended[::-1])]
    assert told[0] == told[1]
    assert told[0][0] == [("failed", 1), ("succeeded", 3)]


def test_a_fleet_without_redis(live: Any) -> None:
    view = look_at_fleet(live.store)
    assert view.workers is None
    assert "Redis does not answer" in drawn(view)


def drawn(view: FleetView, width: int = 120, height: int = 40) -> str:
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True, color_system=None)
    console.print(picture(view, width, height))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.one_machine("tests above ask both databases")
def test_the_picture_in_a_terminal(busy: Any) -> None:
    view = look_at_fleet(busy.store)
    text = drawn(view)
    lines = text.splitlines()
    assert "2 waiting, 2 running, 2.5 steps/s" in lines[0]
    assert "1 of the jobs that wait fit no living worker" in lines[1]
    (at_work,) = [line for line in lines if "host-1" in line]
    assert all(part in at_work for part in ("24", "50% 3.0/24G", "runs", "me", "36 s"))
    (idle,) = [line for line in lines if "host-2" in line]
    assert "idle" in idle
    assert HOSTILE in text, "names are no markup"
    assert "engine_error" in text
    assert view.workers is not None
    many = view.model_copy(update={"workers": view.workers * 30})
    assert len(drawn(many).splitlines()) <= 40, "it fits the terminal"
    assert "more" in drawn(many)
    assert all(len(line) <= 80 for line in drawn(view, width=80).splitlines())


@pytest.mark.one_machine("tests above ask both databases")
def test_the_page_is_for_admins(busy: Any, is_error: Any) -> None:
    admin = busy.store.accounts.create_key("ops", owner="me", scopes=["read", "admin"])
    for key, status in ((busy.key, 403), (admin, 200)):
        with busy.client(None) as browser:
            assert browser.get("/fleet").headers["location"] == "/sign-in?next=/fleet"
            assert browser.get("/fleet/now").status_code == 401
            signed_in = browser.post("/sign-in", data={"key": key, "next": "/fleet"}, headers={"Origin": busy.url})
            assert signed_in.headers["location"] == "/fleet"
            page, now = browser.get("/fleet"), browser.get("/fleet/now")
            assert (page.status_code, now.status_code) == (status, status)
            assert ('href="/fleet"' in browser.get("/").text) is (status == 200)
    assert HOSTILE not in page.text
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.text, re.DOTALL)
    assert found is not None
    brought, asked = (FleetView.model_validate(told) for told in (json.loads(found[1])["fleet"], now.json()))
    assert brought.workers == asked.workers
    assert now.headers["cache-control"] == "no-store"


@pytest.mark.one_machine("a key is a key")
def test_whoever_runs_all_on_one_machine_is_its_admin(live: Any, tmp_path: Path) -> None:
    key = client_key(tmp_path, live.store.accounts, live.url)
    caller = live.store.accounts.authenticate(key)
    assert caller is not None
    assert "admin" in caller.scopes


@pytest.mark.one_machine("tests above ask both databases")
def test_the_command_draws_once(busy: Any) -> None:
    variables = {
        "ADVTEX_DATA_DIR": str(busy.settings.data_dir),
        "ADVTEX_REDIS_URL": busy.settings.redis_url,
        "COLUMNS": "120",
        "PATH": "",
    }
    command = [sys.executable, "-m", "advtex_server.main", "top", "--once"]
    ran = subprocess.run(command, env=variables, capture_output=True, text=True, check=True)
    assert "host-1" in ran.stdout
    assert "engine_error" in ran.stdout
