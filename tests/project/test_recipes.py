"""The recipes of CONTRIBUTING.md, followed to the letter in a copy of the tree."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tiny_scan import FOCAL, HEIGHT, PLY, WIDTH, png, write_scan

ROOT = Path(__file__).parents[2]
ROOMS = ("client", "server", "worker")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "node_modules")


def blocks(title: str) -> list[tuple[str, str]]:
    """The fenced blocks of a section, each with its language."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
    found = re.findall(r"^```(\w+)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    assert found, f"CONTRIBUTING.md has no recipe {title!r}"
    return found


def apply(diff: str, root: Path) -> None:
    """Make the changes of one file: each hunk's context and removed lines are there exactly once."""
    head, *lines = diff.splitlines(keepends=True)
    path = root / head.removeprefix("+++ b/").strip()
    text = path.read_text(encoding="utf-8")
    for hunk in "".join(lines).split("@@\n"):
        marked = [(line[:1], line[1:]) for line in hunk.splitlines(keepends=True)]
        assert {mark for mark, _ in marked} <= {" ", "-", "+"}, hunk
        before = "".join(line for mark, line in marked if mark != "+")
        after = "".join(line for mark, line in marked if mark != "-")
        assert text.count(before) == 1, f"{path.relative_to(root)} does not have these lines once:\n{before}"
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")


def follow(title: str, root: Path) -> None:
    """Write the recipe's files and make its changes; ruff finds nothing in what came of them."""
    touched = []
    for language, text in blocks(title):
        if language == "python":
            path = root / re.match(r"# (\S+)\n", text)[1]  # type: ignore[index]
            assert not path.exists()
            path.write_text(text.partition("\n")[2], encoding="utf-8")
        else:
            apply(text, root)
            path = root / text.partition("\n")[0].removeprefix("+++ b/")
        touched.append(path)
    for command in (["check"], ["format", "--check"]):
        run(root, "-m", "ruff", *command, "--no-cache", *touched)


def run(root: Path, *arguments: object, **environment: str) -> str:
    """Python with the copy's packages; its output."""
    path = os.pathsep.join(str(root / room) for room in ROOMS)
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=root,
        env=os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    print(done.stdout, done.stderr, sep="\n")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The tree, without what was made."""
    root = tmp_path / "tree"
    for name in (*ROOMS, "tests"):
        shutil.copytree(ROOT / name, root / name, ignore=LEFT_OUT)
    shutil.copy(ROOT / "pyproject.toml", root)
    return root


LAYOUT = """
from advtex_engine.conventions.places import PLACES
from advtex_scan import check_scan
from advtex_scan.layouts import LAYOUT_NAMES
import json, sys
assert set(PLACES) == set(LAYOUT_NAMES)
print(json.dumps(check_scan(sys.argv[1]).to_dict()))
"""


def test_a_layout_is_added(copy: Path, tmp_path: Path) -> None:
    scan = tmp_path / "scan"
    scan.mkdir()
    (scan / "mesh.ply").write_text(PLY)
    (scan / "camera.txt").write_text(f"{FOCAL} {FOCAL} {WIDTH / 2 - 0.5} {HEIGHT / 2 - 0.5}\n")
    lines = []
    for i in range(3):
        (scan / f"{i}.png").write_bytes(png(WIDTH, HEIGHT, 40 * i))
        lines.append(f"{i}.png, 1 0 0 {0.1 * (i - 1)} 0 1 0 0 0 0 1 0 0 0 0 1\n")
    (scan / "poses.csv").write_text("".join(lines))

    unknown = json.loads(run(copy, "-c", LAYOUT, scan))
    assert not unknown["ok"]
    follow("Add a layout", copy)
    found = json.loads(run(copy, "-c", LAYOUT, scan))
    assert (found["ok"], found["layout"], found["frames_usable"]) == (True, "pose_table", 3)
    (scan / "poses.csv").write_text("".join(lines).replace("0 1 0 0 0 0 1 0", "0 1 0", 1))
    broken = json.loads(run(copy, "-c", LAYOUT, scan))
    assert [problem["code"] for problem in broken["findings"] if problem["severity"] == "error"][:1] == ["bad_numbers"]


ENDPOINT = """
import asyncio, sys, threading
import uvicorn
from advtex_client import AsyncClient, Client
from advtex_server.app import create_app
from advtex_server.settings import ServerSettings

app = create_app(ServerSettings(data_dir=sys.argv[1], redis_url="redis://127.0.0.1:1/0"))
server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None))
thread = threading.Thread(target=server.run)
thread.start()
while not server.started:
    assert thread.is_alive(), "the server did not start"
    thread.join(0.01)
url = "http://%s:%d" % server.servers[0].sockets[0].getsockname()
key = app.state.service.store.accounts.create_key("me", owner="me")

async def load():
    async with AsyncClient(url, key) as client:
        return await client.get_load()

with Client(url, key) as client:
    print(client.get_load().active_jobs, asyncio.run(load()).active_jobs)
server.should_exit = True
thread.join()
"""


@pytest.mark.slow
def test_an_endpoint_is_added(copy: Path, tmp_path: Path) -> None:
    follow("Add an endpoint", copy)
    run(copy, "client/make_sync_client.py")
    kept = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/server/test_openapi.py", "-k", "kept")
    run(copy, *kept, ADVTEX_WRITE_OPENAPI="1")
    before, after = (json.loads((root / "tests/server/openapi.json").read_text())["paths"] for root in (ROOT, copy))
    assert after.keys() - before.keys() == {"/v1/load"}
    run(copy, *kept)
    assert run(copy, "-c", ENDPOINT, tmp_path / "data").splitlines()[-1] == "0 0"  # after the log


def textured(root: Path, tmp_path: Path, method: str, **environment: str) -> dict[str, Any]:
    """The report of a run of the engine on a tiny scan."""
    scan, flags = write_scan(tmp_path / "scan"), ("--method", method, "--no-refine", "--device", "cpu")
    run(root, "-m", "advtex_engine", "texture", scan, "-o", tmp_path / "out", *flags, **environment)
    report: dict[str, Any] = json.loads((tmp_path / "out" / "report.json").read_text())
    return report


@pytest.mark.slow
def test_a_method_is_added(copy: Path, tmp_path: Path) -> None:
    follow("Add a method", copy)
    assert textured(copy, tmp_path, "first_view")["options"]["method"] == "first_view"
    assert "first_view: each face" in run(copy, "-c", "from advtex_client.cli import main; main()", "submit", "--help")


SERVER = """
import sys
from starlette.testclient import TestClient
from advtex_options.methods import known_methods
from advtex_server.app import create_app
from advtex_server.settings import ServerSettings

app = create_app(ServerSettings(data_dir=sys.argv[1], redis_url="redis://127.0.0.1:1/0"))
with TestClient(app) as http:
    http.headers["Authorization"] = "Bearer " + app.state.service.store.accounts.create_key("me", owner="me")
    upload = http.post("/v1/uploads", content=b"not a zip").json()["id"]
    for place in ("/nowhere", sys.argv[2]):
        sys.path.append(place)
        known_methods.cache_clear()
        answer = http.post("/v1/jobs", json={"upload_id": upload, "options": {"method": "last_view"}})
        print(answer.status_code, answer.json().get("message", answer.json().get("options")))
"""


@pytest.mark.slow
def test_a_package_brings_a_method(tmp_path: Path) -> None:
    lines = 0
    for _, text in blocks("Bring a method in a package of your own"):
        path = tmp_path / "source" / text.partition("\n")[0].removeprefix("# ")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        lines += text.count("\n")
    assert lines < 40
    site = tmp_path / "site"
    pip = ("-m", "pip", "--disable-pip-version-check", "install", "--no-index", "--no-deps", "--no-build-isolation")
    run(ROOT, *pip, "--target", site, tmp_path / "source")
    paths = os.pathsep.join(map(str, (*(ROOT / room for room in ROOMS), site)))

    told = run(ROOT, "-c", SERVER, tmp_path / "data", site)
    assert re.search(r"^422 body.options.method: method 'last_view' is unknown; choose one of", told, re.MULTILINE)
    assert re.search(r"^201 .*'method': 'last_view'", told, re.MULTILINE)
    client = ("-c", "from advtex_client.cli import main; main()")
    assert "last_view: each face" in run(ROOT, *client, "submit", "--help", PYTHONPATH=paths)

    assert textured(ROOT, tmp_path, "last_view", PYTHONPATH=paths)["options"]["method"] == "last_view"


OPTION = """
from advtex_contract.options import JobOptions
from advtex_worker.adapt import texture_config
print(texture_config(JobOptions(texels_per_pixel=2), "cpu").texels_per_pixel)
try:
    JobOptions(texels_per_pixel=5)
except ValueError as error:
    print("out of bounds" in str(error))
"""
OPTION_ON_THE_PAGE = """
from advtex_client.manifests import COLUMNS
from advtex_server.routes.pages import submit_options
about = {field["name"]: field["about"] for field in submit_options()}["texels_per_pixel"]
print("texels_per_pixel", about.low, about.high, "texels_per_pixel" in COLUMNS)
"""


def test_an_option_is_added(copy: Path) -> None:
    follow("Add an option", copy)
    assert run(copy, "-c", OPTION) == "2.0\nTrue\n"
    client = ("-c", "from advtex_client.cli import main; main()")
    for command in (("-m", "advtex_engine", "texture"), (*client, "submit"), (*client, "batch", "submit")):
        told = " ".join(run(copy, *command, "--help").split())
        assert "--texels-per-pixel N of the sharpest view, along each side. 0.25 to 4 texels [default: (1.2)]" in told
    assert run(copy, "-c", OPTION_ON_THE_PAGE).split() == ["texels_per_pixel", "0.25", "4", "True"]
