"""The command line: data on stdout, notes on stderr, exit codes that scripts can rely on."""

from __future__ import annotations

import importlib
import importlib.util
import json
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
from fake_server import NOW, FakeServer, answers, refuses, view
from typer.main import get_command
from typer.testing import CliRunner, Result

from advtex_client import cli, cli_batch
from advtex_client._display import duration, job_lines, job_table
from advtex_client.client import Client
from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.jobs import BatchView, JobError, JobPage, JobState, ResultFile
from advtex_engine.__main__ import app as engine_app
from advtex_options import described

WHY = "no worker is running"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> FakeServer:
    made = FakeServer()

    def connect(url: str | None, api_key: str | None) -> Client:
        return Client(url or "http://server.test", api_key or "k", transport=made.transport, retries=1)

    monkeypatch.setattr(cli, "Client", connect)
    return made


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def test_submit_prints_the_id_and_nothing_else(server: FakeServer, scan: Path) -> None:
    ran = run(
        "submit", scan, "--preset", "preview", "--size", "320x240", "--holdout", "8", "--seed", "3", "--label", "x"
    )
    assert (ran.exit_code, ran.stdout) == (0, "j0\n")
    options = server.jobs["j0"].options
    assert (options.preset.value, options.width, options.height, options.holdout, options.seed) == (
        "preview",
        320,
        240,
        8,
        3,
    )
    assert server.jobs["j0"].label == "x"
    assert run("submit", scan, "--new").stdout == "j1\n"


def test_json_on_every_command(server: FakeServer, scan: Path, tmp_path: Path) -> None:
    assert json.loads(run("check", scan, "--json").stdout)["ok"] is True
    assert json.loads(run("submit", scan, "--json").stdout)["id"] == "j0"
    for command in ("status", "cancel", "retry"):
        assert json.loads(run(command, "j0", "--json").stdout)["id"] == "j0"
    server.finish("j0", {"model.obj": b"o"})
    assert json.loads(run("watch", "j0", "--json").stdout)["state"] == "succeeded"
    fetched = run("submit", scan, "--json", "-o", tmp_path / "out")
    assert json.loads(fetched.stdout)["files"] == [str(tmp_path / "out" / "model.obj")]
    assert json.loads(run("download", "j0", "-o", tmp_path, "--json").stdout) == [str(tmp_path / "model.obj")]
    assert json.loads(run("delete", "j0", "--json").stdout) == {"id": "j0", "deleted": True}


def test_a_bad_scan_is_4_with_every_finding_and_its_remedy(server: FakeServer, scan: Path) -> None:
    (scan / "mesh.ply").unlink()
    (scan / "color" / "1.png").write_bytes(b"no image")
    ran = run("submit", scan)
    assert ran.exit_code == 4
    assert "mesh.ply" in ran.stderr
    assert "color/1.png" in ran.stderr
    assert " -> " in ran.stderr
    assert ran.stdout == ""
    assert server.requests == []
    assert run("check", scan).exit_code == 4
    as_json = run("submit", scan, "--json")
    body = json.loads(as_json.stderr)["error"]
    assert (body["code"], body["exit_code"]) == ("invalid_scan", 4)
    assert all(detail["remedy"] for detail in body["details"] if detail["severity"] == "error")


@pytest.mark.parametrize(
    ("state", "exit_code"), [(JobState.queued, 0), (JobState.running, 0), (JobState.rejected, 4), (JobState.failed, 5)]
)
def test_submit_waits_for_the_servers_check(server: FakeServer, scan: Path, state: JobState, exit_code: int) -> None:
    server.begins = JobState.checking
    details = [ErrorDetail(where="mesh.ply", message="is empty", remedy="add faces")]
    error = JobError(code="x", message="the scan cannot be textured", details=details) if exit_code else None
    warnings = [] if exit_code else [ErrorDetail(severity="warning", message="is dark")]
    server.script = [
        view("j0", JobState.checking, waiting_reason="its scan is being checked"),
        view("j0", state, error=error, warnings=warnings),
    ]
    ran = run("submit", scan, "--json")
    assert ran.exit_code == exit_code
    assert json.loads(ran.stdout)["state"] == state
    assert "job j0: checking (its scan is being checked)" in ran.stderr
    assert "submitted before" not in ran.stderr
    if exit_code == 4:
        assert json.loads(ran.stderr.splitlines()[-1])["error"]["details"][0]["remedy"] == "add faces"
    elif exit_code == 0:
        assert "is dark" in ran.stderr
    again = run("submit", scan)
    assert again.exit_code == 0
    assert ("submitted before" in again.stderr) == bool(exit_code)


def test_a_check_that_takes_too_long_is_7(server: FakeServer, scan: Path) -> None:
    server.begins = JobState.checking
    ran = run("submit", scan, "--timeout", "0.05")
    assert ran.exit_code == 7
    assert "checking at last sight" in ran.stderr


def test_a_layout_can_be_asked_for(server: FakeServer, scan: Path) -> None:
    assert json.loads(run("check", scan, "--layout", "native", "--json").stdout)["layout"] == "native"
    refused = run("check", scan, "--layout", "tum")
    assert refused.exit_code == 4
    assert "not laid out as tum; they look like native" in refused.stdout
    assert run("submit", scan, "--layout", "tum").exit_code == 4
    assert not server.jobs
    assert run("submit", scan, "--layout", "native").exit_code == 0
    assert server.jobs["j0"].options.layout == "native"


def test_how_long_a_job_is_kept_is_asked_and_shown(server: FakeServer, scan: Path) -> None:
    assert run("submit", scan, "--keep-days", "1.5").exit_code == 0
    assert server.jobs["j0"].retention_seconds == 129_600
    assert "1.5 days after its end" in run("status", "j0").stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "big"], "give it as WIDTHxHEIGHT"),
        (["--size", "10x10"], "64 to 4096"),
        (["--steps", "0"], "steps"),
        (["--max-texture-size", "100000"], "max_texture_size"),
        (["--face-budget", "1"], "face_budget"),
        (["--keep-days", "0"], "--keep-days 0"),
        (["--keep-days", "0.0001"], "retention_seconds 9"),
        (["--preset", "turbo"], "turbo"),
        (["--method", "magic"], "magic"),
        (["--layout", "magic"], "tum"),
        (["--label", "two\nlines"], "label"),
    ],
)
def test_options_out_of_bounds_are_2_and_named(
    server: FakeServer, scan: Path, arguments: list[str], words: str
) -> None:
    ran = run("submit", scan, *arguments)
    assert ran.exit_code == 2
    assert words in ran.stderr
    assert server.requests == []


def test_all_commands_that_make_jobs_have_every_option() -> None:
    commands: Any = get_command(cli.app)
    engine: Any = get_command(engine_app)
    flags = {f"--{name.replace('_', '-')}" for name in described()}
    for command in (
        commands.commands["submit"],
        commands.commands["batch"].commands["submit"],
        engine.commands["texture"],
    ):
        found = {flag: one.help for one in command.params for flag in one.opts if flag in flags}
        assert found.keys() == flags
        assert all(about.help in found[f"--{name.replace('_', '-')}"] for name, about in described().items())


def test_jobs_can_belong_together(server: FakeServer, scan: Path) -> None:
    assert run("submit", scan, "--batch", "night").exit_code == 0
    assert run("submit", scan).exit_code == 0
    assert run("submit", scan, "--batch", "night").stdout == "j0\n"
    assert [job.batch for job in server.jobs.values()] == ["night", None]


def test_no_command_no_file_and_no_server_are_2(scan: Path, tmp_path: Path) -> None:
    assert run("paint").exit_code == 2
    assert run("submit", tmp_path / "nowhere").exit_code == 2
    ran = run("status", "j0")
    assert ran.exit_code == 2
    assert "ADVTEX_URL" in ran.stderr


@pytest.mark.parametrize(
    ("fault", "exit_code"),
    [
        (answers(401, ErrorCode.unauthorized), 3),
        (answers(403, ErrorCode.forbidden), 3),
        (answers(404, ErrorCode.not_found), 2),
        (answers(409, ErrorCode.conflict), 2),
        (refuses, 6),
        (answers(500, ErrorCode.internal), 6),
        (answers(503), 6),
        (answers(507, ErrorCode.insufficient_storage), 6),
    ],
)
def test_every_kind_of_error_has_its_exit_code(server: FakeServer, fault: object, exit_code: int) -> None:
    server.faults = [fault, fault]  # type: ignore[list-item]
    ran = run("status", "j0")
    assert ran.exit_code == exit_code
    assert ran.stderr.startswith("error: ")
    assert ran.stdout == ""


@pytest.mark.parametrize(
    ("state", "exit_code"),
    [(JobState.failed, 5), (JobState.canceled, 5), (JobState.rejected, 4), (JobState.succeeded, 0)],
)
def test_waiting_ends_as_the_job_does(server: FakeServer, state: JobState, exit_code: int) -> None:
    error = JobError(code="x", message="out of paint", details=[ErrorDetail(message="buy some", remedy="at the shop")])
    server.jobs["j0"] = view("j0", state, error=None if exit_code == 0 else error)
    assert run("watch", "j0").exit_code == exit_code


def test_a_wait_that_is_too_long_is_7(server: FakeServer) -> None:
    server.jobs["j0"] = view("j0", JobState.running)
    ran = run("watch", "j0", "--timeout", "0.05")
    assert ran.exit_code == 7
    assert "it goes on" in ran.stderr


def test_an_interrupt_is_130(server: FakeServer) -> None:
    def interrupted(_request: object) -> None:
        raise KeyboardInterrupt

    server.faults = [interrupted]  # type: ignore[list-item]
    ran = run("status", "j0")
    assert ran.exit_code == 130
    assert "interrupted" in ran.stderr


def test_listing(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [view("j2", JobState.running, step=5, label="[bold]kitchen[/bold]"), view("j1")]
    jobs[0].progress.stage, jobs[0].progress.steps = "optimization", 10
    lines = job_table(jobs).splitlines()
    assert len(lines) == 3
    assert lines[1].split() == ["j2", "running", "optimization", "5/10", "2026-01-01", "00:00", "[bold]kitchen[/bold]"]


def test_a_job_in_words() -> None:
    error = JobError(code="x", message="no paint", log_tail="\n".join(f"line {i}" for i in range(30)))
    job = view("j0", JobState.failed, step=5, attempt=2, label="kitchen", error=error)
    job.progress.stage, job.progress.steps, job.progress.eta_seconds = "optimization", 10, 200.0
    text = job_lines(job)
    for words in ("failed (attempt 2)", "step 5 of 10", "no paint", "line 29", "line 15"):
        assert words in text
    assert "line 14" not in text
    assert "left" not in text, "nothing is left of a job that has ended"
    running = job_lines(job.model_copy(update={"state": JobState.running}))
    assert "about 3 min 20 s" in running
    names = ("index.html", "previews/manifest.json", "previews/views/0.jpg")
    files = [ResultFile(name=name, size=4, sha256="0" * 64, content_type="x", url="/") for name in names]
    job.progress.notes = ["12 of 30 frames become views"]
    ended = job_lines(job.model_copy(update={"results": files})).splitlines()
    assert "note     12 of 30 frames become views" in ended
    told = [line for line in ended if line.startswith("result")]
    assert told == ["result   index.html (4 bytes)", "result   previews/ (2 files, 8 bytes)"]


def test_why_a_job_waits_is_shown_wherever_it_is(server: FakeServer) -> None:
    waiting = view("j0", waiting_reason=WHY)
    server.jobs["j0"] = waiting
    assert f"waits    {WHY}" in run("status", "j0").stdout
    assert WHY in job_table([waiting])
    server.script = [waiting, waiting, view("j0", JobState.running), view("j0", JobState.succeeded)]
    notes = run("watch", "j0").stderr.splitlines()
    assert notes == [f"job j0: queued ({WHY})", "job j0: running", "job j0: succeeded"]


def test_a_batch_says_why_its_jobs_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    states = {JobState.queued: 3, JobState.succeeded: 1}
    batch = BatchView(id="night", jobs=4, states=states, finished=False, created_at=NOW, updated_at=NOW)
    reasons = ["it is too large", WHY, WHY]
    jobs = [view(f"j{n}", waiting_reason=reason) for n, reason in enumerate(reasons)]

    def handle(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/v1/batches/night":
            return httpx.Response(200, text=batch.model_dump_json())
        assert dict(request.url.params) == {"batch": "night", "state": "queued", "limit": "100"}
        return httpx.Response(200, text=JobPage(jobs=jobs).model_dump_json())

    def connect(url: str | None, api_key: str | None) -> Client:
        return Client("http://server.test", "k", transport=httpx.MockTransport(handle))

    monkeypatch.setattr(cli_batch, "Client", connect)
    line = f"night: 4 jobs, 3 queued, 1 succeeded; waiting: {WHY}; it is too large\n"
    assert run("batch", "status", "night").stdout == line
    waited = run("batch", "status", "night", "--wait", "--timeout", "0")
    assert waited.exit_code == 7
    assert WHY in waited.stderr


def test_submitting_a_finished_scan_again_says_so(server: FakeServer, scan: Path) -> None:
    run("submit", scan)
    warning = ErrorDetail(severity="warning", where="pose.txt", message="2 frames dropped", remedy="fix them")
    error = JobError(code="x", message="no paint")
    server.jobs["j0"] = view("j0", JobState.failed, error=error, warnings=[warning])
    again = run("submit", scan)
    assert (again.exit_code, again.stdout) == (0, "j0\n")
    assert "retry j0" in again.stderr
    assert "--new" in again.stderr
    assert "warning: pose.txt: 2 frames dropped -> fix them" in again.stderr


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (60, "1 min 0 s"), (7500, "2 h 5 min")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_the_client_stays_light() -> None:
    """What `pip install advtex` brings is enough, and nothing heavier is imported even where it is installed."""
    heavy = [
        "numpy",
        "torch",
        "cv2",
        "fastapi",
        "redis",
        "rq",
        "sqlalchemy",
        "boto3",
        "advtex_store",
        "advtex_engine",
    ]
    code = f"import sys, advtex_client.cli; sys.exit(', '.join(m for m in {heavy} if m in sys.modules) or 0)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_the_installed_command_exists() -> None:
    assert callable(importlib.import_module("advtex_client.cli").main)


def deep_answer(monkeypatch: pytest.MonkeyPatch, hopeless: bool, stdout: str | None = None) -> list[list[str]]:
    """Lets the engine's process answer at once; the commands that were asked for."""
    problem = {"code": "camera_axes", "where": "scan.json", "message": "the poses seem to be", "remedy": "turn them"}
    report = {"frames": 14, "summary": "all agrees", "hopeless": hopeless, "problems": [problem] if hopeless else []}
    asked = []

    def answer(command: list[str], **_options: object) -> subprocess.CompletedProcess[str]:
        asked.append(command)
        return subprocess.CompletedProcess(command, 1, json.dumps(report) if stdout is None else stdout, "no such\nwhy")

    monkeypatch.setattr(subprocess, "run", answer)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    return asked


def test_a_deep_check_adds_what_the_engine_measured(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = deep_answer(monkeypatch, hopeless=False)
    ran = run("check", scan, "--deep")
    assert ran.exit_code == 0
    assert "measured 14 frames: all agrees\nno other convention fits clearly better" in ran.stdout
    assert asked == [[sys.executable, "-m", "advtex_engine", "check", str(scan), "--json"]]
    deep_answer(monkeypatch, hopeless=True)
    ran = run("check", scan, "--deep", "--json")
    assert ran.exit_code == 4
    assert json.loads(ran.stdout)["conventions"]["problems"][0]["code"] == "camera_axes"
    assert "error    scan.json: the poses seem to be\n         -> turn them" in run("check", scan, "--deep").stdout


def test_a_deep_check_without_the_engine_says_what_to_install(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    ran = run("check", scan, "--deep")
    assert ran.exit_code == 2
    assert 'pip install "advtex[worker]"' in ran.stderr
    deep_answer(monkeypatch, hopeless=False, stdout="")
    assert "the engine could not measure" in run("check", scan, "--deep").stderr


def test_what_is_said_of_a_batch_as_a_whole(monkeypatch: pytest.MonkeyPatch, scan: Path, tmp_path: Path) -> None:
    """By the command line; a server from before that is told apart from a batch that is not there."""
    asked: list[tuple[str, str, str]] = []
    paused, knows = False, True

    def handle(request: httpx.Request) -> httpx.Response:
        asked.append((request.method, request.url.path, request.content.decode()))
        if request.method == "PUT":
            return httpx.Response(204) if knows else httpx.Response(404, json={"code": "not_found", "message": "no"})
        if request.url.path == "/v1/jobs":
            spec = json.loads(request.content)
            return httpx.Response(201, text=view("j0", label=spec["label"]).model_dump_json())
        told = paused if request.method == "GET" else request.url.path.endswith("pause")
        batch = BatchView(id="night", jobs=1, states={}, finished=False, paused=told, created_at=NOW, updated_at=NOW)
        return httpx.Response(200, text=batch.model_dump_json())

    def connect(url: str | None, api_key: str | None) -> Client:
        return Client("http://server.test", "k", transport=httpx.MockTransport(handle), retries=0)

    monkeypatch.setattr(cli_batch, "Client", connect)
    options, manifest = tmp_path / "night.toml", tmp_path / "list.csv"
    options.write_text('preset = "full"\nsize = "320x240"\n')
    manifest.write_text("path\nfile:///scans/a\n")
    flags = ("--options", options, "--preset", "preview", "--max-running", "3", "--deadline", "2026-01-31T08:00+00:00")
    assert run("batch", "submit", manifest, "--id", "night", *flags).exit_code == 0
    assert asked[0] == ("PUT", "/v1/batches/night/limits", '{"max_running":3}')
    spec = json.loads(asked[1][2])
    assert (spec["options"]["preset"], spec["options"]["width"]) == ("preview", 320), "a flag goes before the file"
    assert datetime.fromisoformat(spec["deadline"]).timestamp() == 1769846400
    knows = False
    refused = run("batch", "submit", manifest, "--id", "night", *flags)
    assert (refused.exit_code, "leave --max-running out" in refused.stderr) == (2, True)
    assert run("batch", "submit", manifest, "--id", "night", "--deadline", "soon").exit_code == 2
    assert "paused" in run("batch", "pause", "night").stdout
    asked.clear()
    paused = True
    resumed = run("batch", "resume", "other")
    assert (resumed.exit_code, [path for _, path, _ in asked]) == (0, ["/v1/batches/other", "/v1/batches/other/resume"])
    assert "paused" not in resumed.stdout
    paused = False
    assert run("batch", "resume", "other").exit_code == 2, "not paused, and submitted elsewhere"
    asked.clear()
    assert run("batch", "resume", "night").exit_code == 0
    assert ("POST", "/v1/jobs") in [(method, path) for method, path, _ in asked]
