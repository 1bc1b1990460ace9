"""The report of a batch: one page for people, CSV and JSON for programs, whatever users and scans are called."""

from __future__ import annotations

import csv
import json
import re
import threading
from collections.abc import Callable
from datetime import timedelta
from html.parser import HTMLParser
from pathlib import Path

import httpx
import pytest
from fake_server import NOW, FakeServer, ok, view
from typer.testing import CliRunner, Result

from advtex_client import cli, cli_batch
from advtex_client.batch_comparison import compared
from advtex_client.client import Client
from advtex_contract.errors import ErrorDetail
from advtex_contract.jobs import BatchView, JobError, JobPage, JobState, JobView, Progress

HOSTILE = "<img src=x onerror=alert(1)>\"'&</td></script><script>alert(2)</script>"
FORMULA = '=HYPERLINK("http://evil")'
JPEG = b"\xff\xd8\xff picture"
Connect = Callable[[dict[str, list[JobView]]], None]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, ["batch", *map(str, arguments)])


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Connect:
    """The client finds these batches, and the same results of every job that succeeded."""

    def with_batches(batches: dict[str, list[JobView]]) -> None:
        server = FakeServer()
        server.jobs = {job.id: job for jobs in batches.values() for job in jobs}

        def handle(request: httpx.Request) -> httpx.Response:
            if match := re.fullmatch(r"/v1/batches/(\w+)", request.url.path):
                if match[1] not in batches:
                    return server.answer(httpx.Request("GET", "http://server.test/v1/none"))
                return ok(summary(match[1], batches[match[1]]))
            if request.url.path == "/v1/jobs":
                return ok(JobPage(jobs=batches[request.url.params["batch"]]))
            return server.answer(request)

        for job in server.jobs.values():
            if job.state is JobState.succeeded:
                score = 0.5 if job.id.endswith("0") else 0.25
                report = {"heldout": {"texture": {"lpips": score, "views": 3, "s3_ratio": float("nan")}}}
                files = {"previews/thumbnail.jpg": JPEG, "report.json": json.dumps(report).encode()}
                server.finish(job.id, files)
                job.results = server.jobs[job.id].results
                results[job.id] = files

        def result_of(request: httpx.Request) -> httpx.Response:
            with one_at_a_time:
                if match := re.match(r"/v1/jobs/(\w+)/results/", request.url.path):
                    server.results = results[match[1]]
                return handle(request)

        def client(url: str | None, api_key: str | None) -> Client:
            return Client("http://server.test", "k", transport=httpx.MockTransport(result_of))

        monkeypatch.setattr(cli_batch, "Client", client)

    one_at_a_time = threading.Lock()
    results: dict[str, dict[str, bytes]] = {}
    return with_batches


def summary(name: str, jobs: list[JobView]) -> BatchView:
    states = {state: sum(job.state is state for job in jobs) for state in {job.state for job in jobs}}
    return BatchView(id=name, jobs=len(jobs), states=states, finished=True, created_at=NOW, updated_at=NOW)


def night() -> list[JobView]:
    done = Progress(steps=400, stage_seconds={"ingest": 2.0, "optimization": 58.04})
    ended = {"progress": done, "attempt": 2, "finished_at": NOW + timedelta(hours=1)}
    remedy = ErrorDetail(where="color/<1>.png", message="is no image", remedy="export it again")
    why = JobError(code="x", message="the scan cannot be <b>textured</b>", details=[remedy])
    return [
        view("j0", JobState.succeeded, label=HOSTILE, **ended),
        view("j1", JobState.succeeded, label=FORMULA, **ended),
        view("j2", JobState.rejected, label="bad", error=why),
    ]


class Elements(HTMLParser):
    """Every element with its attributes, and the text of cells."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_the_report_is_one_page_with_csv_and_json_beside_it(connect: Connect, tmp_path: Path) -> None:
    connect({"night": night()})
    ran = run("report", "night", "-o", tmp_path / "out" / "report.html", "--json")
    assert ran.exit_code == 0, ran.stderr
    files = [tmp_path / "out" / f"report.{kind}" for kind in ("html", "csv", "json")]
    assert json.loads(ran.stdout) == {"files": [str(file) for file in files]}
    page, table, data = (file.read_text() for file in files)
    assert "3 jobs, 1 rejected, 2 succeeded; 2 min 0 s of GPU time<" in page
    assert '<th scope="row">mean</th>' in page
    assert '<td class="number">0.375</td>' in page
    assert page.count('src="data:image/jpeg;base64,/9j/IHBpY3R1cmU="') == 2
    assert "the scan cannot be &lt;b&gt;textured&lt;/b&gt;\nerror: color/&lt;1&gt;.png: is no image" in page
    rows = {row["job"]: row for row in csv.DictReader(table.splitlines(keepends=True))}
    assert (rows["j0"]["gpu_seconds"], rows["j0"]["elapsed_seconds"], rows["j0"]["lpips"]) == ("60.0", "3600.0", "0.5")
    assert rows["j2"]["reason"].endswith("is no image -> export it again")
    told = json.loads(data)
    assert BatchView.model_validate(told["batch"]).id == "night"
    assert {job["label"] for job in told["jobs"]} == {HOSTILE, FORMULA, "bad"}, "in the JSON they are as they are"
    assert next(job for job in told["jobs"] if job["job"] == "j0")["stage_seconds"]["optimization"] == 58.04


def test_reasons_are_told_once_with_those_that_have_them(connect: Connect, tmp_path: Path) -> None:
    """The message of a scan that a worker could not read tells of all problems, of which there are details too."""
    places = [ErrorDetail(where=f"color/{n}.png", message="cannot be decoded", remedy="leave it out") for n in range(9)]
    why = JobError(code="x", message="color/0.png and 8 more: cannot be decoded (leave it out)", details=places)
    lost = [view(f"j{n}", JobState.failed, label=f"hall{n}", error=why) for n in range(2)]
    connect({"night": [*lost, view("j2", label="attic", waiting_reason="no worker is running")]})
    assert run("report", "night", "-o", tmp_path / "r.html").exit_code == 0
    page = (tmp_path / "r.html").read_text()
    (reasons,) = re.findall(r"<ul>.*</ul>", page, re.DOTALL)
    assert page.count("cannot be decoded") == reasons.count("cannot be decoded") == 1
    links = re.findall(r'<a href="#(\w+)">(\w+)</a>', reasons)
    assert links == [("j2", "attic"), ("j0", "hall0"), ("j1", "hall1")]
    assert all(f'<tr id="{job}">' in page for job, _ in links)
    connect({"night": [view(f"j{n}", label=f"hall{n:02}", waiting_reason="its turn comes") for n in range(23)]})
    assert run("report", "night", "-o", tmp_path / "r.html").exit_code == 0
    assert ">hall19</a> and 3 more<" in (tmp_path / "r.html").read_text()


def test_columns_that_say_nothing_are_not_shown(connect: Connect, tmp_path: Path) -> None:
    connect({"night": night()})
    assert run("report", "night", "-o", tmp_path / "r.html").exit_code == 0
    heads = re.findall(r"<button>(.*?)</button>", (tmp_path / "r.html").read_text())
    assert heads == ["label", "state", "attempt", "steps", "gpu seconds", "elapsed seconds", "lpips"]
    connect({"night": [view("j0", JobState.failed, label="hall")]})
    assert run("report", "night", "-o", tmp_path / "r.html").exit_code == 0
    heads = re.findall(r"<button>(.*?)</button>", (tmp_path / "r.html").read_text())
    assert heads == ["label", "state", "gpu seconds"]


def test_what_users_write_stays_text(connect: Connect, tmp_path: Path) -> None:
    connect({"night": night()})
    assert run("report", "night", "-o", tmp_path / "r.html").exit_code == 0
    read = Elements((tmp_path / "r.html").read_text())
    assert [tag for tag, _ in read.found].count("script") == 1
    images = [attributes for tag, attributes in read.found if tag == "img"]
    assert [set(image) for image in images] == [{"alt", "decoding", "src"}] * 2
    assert HOSTILE in {image["alt"] for image in images}
    assert HOSTILE in read.texts
    assert not any(name.startswith("on") for _, attributes in read.found for name in attributes)
    assert all(not str(attributes.get("src", "data:")).startswith("http") for _, attributes in read.found)
    (policy,) = [a["content"] for _, a in read.found if a.get("http-equiv") == "Content-Security-Policy"]
    assert str(policy).startswith("default-src 'none'")
    cells = [cell for row in csv.reader((tmp_path / "r.csv").read_text().splitlines(keepends=True)) for cell in row]
    assert f"'{FORMULA}" in cells
    assert not any(cell.startswith("=") for cell in cells)


def test_a_report_without_scores_or_results(connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    connect({"night": [view("j2", label="waits", waiting_reason="no worker is running")]})
    monkeypatch.chdir(tmp_path)
    ran = run("report", "night")
    assert ran.stdout == "night.html\nnight.csv\nnight.json\n"
    page = (tmp_path / "night.html").read_text()
    assert "no worker is running" in page
    assert "<img" not in page


def test_where_a_report_cannot_go_is_said(connect: Connect, tmp_path: Path) -> None:
    connect({"night": night()})
    ran = run("report", "night", "-o", tmp_path / "report.csv")
    assert (ran.exit_code, list(tmp_path.glob("report*"))) == (2, [])
    assert "does not end in .html" in ran.stderr
    (tmp_path / "file").touch()
    assert run("report", "night", "-o", tmp_path / "file" / "r.html").exit_code == 2
    assert run("report", "none").exit_code == 2


def test_two_batches_are_compared_by_label(connect: Connect) -> None:
    spent = {"progress": Progress(stage_seconds={"x": 60.0})}
    first = [view(f"a{n}", JobState.succeeded, label=label, **spent) for n, label in ((0, "hall"), (1, "bath"))]
    first.append(view("a2", JobState.failed, label="attic", **spent))
    less = {"progress": Progress(stage_seconds={"x": 45.0})}
    second = [view(f"b{n}", JobState.succeeded, label=label, **less) for n, label in ((1, "hall"), (10, "bath"))]
    connect({"night1": first, "night2": second})
    ran = run("compare", "night1", "night2", "--json")
    found = json.loads(ran.stdout)
    assert ran.exit_code == 5, "a job of the first failed"
    scans = {scan["label"]: scan for scan in found["scans"]}
    assert scans["hall"]["scores"] == {"lpips": -0.25}
    assert scans["bath"]["scores"] == {"lpips": 0.25}
    assert scans["attic"] == {
        "label": "attic",
        "states": ["failed", None],
        "gpu_seconds": [60.0, None],
        "gpu_seconds_difference": None,
        "scores": {},
    }
    assert found["scores"] == {"lpips": {"mean": 0.0, "scans": 2, "worst": 0.25, "label": "bath"}}
    assert found["gpu_seconds"] == {"mean": -15.0, "scans": 2, "worst": -15.0, "label": "bath"}
    lines = run("compare", "night1", "night2").stdout.splitlines()
    assert lines[1].split() == ["attic", "failed", "->", "none", "1", "min", "0", "s", "->"]
    assert lines[-2] == "lpips: mean +0 over 2 scans, worst +0.25 (bath)"
    connect({"night1": first[:2], "night2": second})
    assert run("compare", "night1", "night2").exit_code == 0
    assert run("compare", "night1", "none").exit_code == 2


def test_scans_of_one_batch_alone_are_counted(connect: Connect) -> None:
    night = [view(f"a{n}", JobState.succeeded, label=f"hall{n}") for n in range(9)]
    connect({"night1": night, "night2": [view("b0", JobState.succeeded, label="hall8")]})
    lines = run("compare", "night1", "night2").stdout.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["label", "hall8"]
    assert "only in the first, and succeeded: 8 (hall0, hall1, hall2 ...)" in lines
    assert not any(line.startswith("hall0") for line in lines)


def test_the_worst_of_a_score_is_where_it_became_worse() -> None:
    low = {"psnr": 20.0, "s3_ratio": 0.9}
    first = [{"label": n, "job": n, "state": "x", "scores": low} for n in "ab"]
    scores = {"a": {"psnr": 25.0, "s3_ratio": 1.0}, "b": {"psnr": 19.0, "s3_ratio": 0.5}}
    second = [{"label": n, "job": n, "state": "x", "scores": scores[n]} for n in "ab"]
    found = compared(first, second)["scores"]
    assert (found["psnr"]["label"], found["psnr"]["worst"], found["psnr"]["mean"]) == ("b", -1.0, 2.0)
    assert (found["s3_ratio"]["label"], found["s3_ratio"]["worst"]) == ("b", pytest.approx(-0.4))
