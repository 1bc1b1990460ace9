"""What is shipped: the two commands, the images, the fleet, and the light client."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import psutil
import pytest
import redis
import yaml
from live_service import process_tree, wait_until
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version
from tiny_scan import write_scan, write_zip

from advtex_server.settings import ServerSettings
from advtex_store.queue import JobQueue
from advtex_store.settings import StoreSettings
from advtex_worker.settings import WorkerSettings

ROOT = Path(__file__).parents[2]
ROOMS = ("client", "server", "worker")
DOCKERFILES = sorted((ROOT / "docker").glob("*.Dockerfile"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
SETTINGS: dict[str, type[StoreSettings]] = {
    "server": ServerSettings,
    "worker": WorkerSettings,
    "worker-cpu": WorkerSettings,
}
HEAVY = ("torch", "fastapi", "redis", "rq", "numpy", "sqlalchemy", "cv2")


def tool(name: str, *arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """A command of this environment; its output is shown when the test fails."""
    command = [str(Path(sys.executable).parent / name), *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=240, check=False)
    print(done.stdout, done.stderr, sep="\n")
    return done


def known_variables(settings: type[StoreSettings]) -> set[str]:
    return {f"ADVTEX_{name.upper()}" for name in settings.model_fields}


def packages() -> set[str]:
    return {path.parent.name for room in ROOMS for path in (ROOT / room).glob("*/__init__.py")}


def requirements() -> list[Requirement]:
    """Everything that this project asks for by name, extras and groups included."""
    project = PROJECT["project"]
    lists = [
        project["dependencies"],
        *project["optional-dependencies"].values(),
        *PROJECT["dependency-groups"].values(),
    ]
    found = [Requirement(line) for lines in lists for line in lines]
    return [requirement for requirement in found if requirement.name != "advtex"]


def pins() -> dict[str, Version]:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    return {canonicalize_name(name): Version(version) for name, _, version in (line.partition("==") for line in lines)}


class TestPins:
    def test_every_requirement_is_pinned_within_its_range(self) -> None:
        pinned = pins()
        for requirement in requirements():
            assert pinned[canonicalize_name(requirement.name)] in requirement.specifier, str(requirement)

    def test_pins_fit_every_build_of_a_version(self) -> None:
        assert [name for name, version in pins().items() if version.local] == []

    def test_the_pip_that_installs_knows_dependency_groups(self) -> None:
        assert pins()["pip"] >= Version("25.1")

    def test_the_makefile_asks_for_the_same_python_as_the_package(self) -> None:
        bounds = re.search(r"\((\d), (\d+)\) <= v < \((\d), (\d+)\)", (ROOT / "Makefile").read_text())
        assert bounds is not None
        least, below = ".".join(bounds.group(1, 2)), ".".join(bounds.group(3, 4))
        assert SpecifierSet(PROJECT["project"]["requires-python"]) == SpecifierSet(f">={least},<{below}")
        named = [line.rpartition(" ")[2] for line in PROJECT["project"]["classifiers"] if " :: 3." in line]
        assert named[0] == least
        assert all(Version(name) < Version(below) for name in named)


class TestPackages:
    def test_every_package_is_shipped_typed_and_linted(self) -> None:
        tools = PROJECT["tool"]
        shipped = {Path(path).name for path in tools["hatch"]["build"]["targets"]["wheel"]["packages"]}
        assert shipped == set(tools["mypy"]["packages"]) == set(tools["importlinter"]["root_packages"]) == packages()
        assert {path.parent.name for room in ROOMS for path in (ROOT / room).glob("*/py.typed")} == packages()

    def test_imports_point_down(self) -> None:
        assert tool("lint-imports").returncode == 0

    def test_the_linter_sees_an_import_that_points_up(self, tmp_path: Path) -> None:
        shutil.copy(ROOT / "pyproject.toml", tmp_path)
        for room in ROOMS:
            shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
        (tmp_path / "client/advtex_scan/upwards.py").write_text("import advtex_engine\n")
        path = os.pathsep.join(str(tmp_path / room) for room in ROOMS)
        linter = Path(sys.executable).with_name("lint-imports")
        command = ["env", f"PYTHONPATH={path}", str(linter), "--no-cache"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 1
        assert "advtex_scan.upwards -> advtex_engine" in done.stdout


def test_shellcheck_finds_nothing() -> None:
    assert tool("shellcheck", *(ROOT / ".ci").iterdir(), *(ROOT / "docker" / "slurm").iterdir()).returncode == 0


class TestImages:
    @pytest.mark.parametrize("file", DOCKERFILES, ids=lambda file: file.stem)
    def test_hadolint_finds_nothing(self, file: Path) -> None:
        assert tool("hadolint", "--no-color", file).returncode == 0

    @pytest.mark.parametrize("file", DOCKERFILES, ids=lambda file: file.stem)
    def test_an_image_is_pinned_small_and_runs_as_nobody_special(self, file: Path) -> None:
        text = file.read_text()
        bases = re.findall(r"^FROM (\S+)", text, re.MULTILINE)
        assert len(bases) == 2
        assert all(re.fullmatch(r"python:3\.1[12]\.\d+-slim-\w+", base) for base in bases)
        last = text.rpartition("FROM ")[2]
        assert re.findall(r"^USER (\S+)", last, re.MULTILINE) == ["10001"]
        assert "HEALTHCHECK" in last
        assert re.search(r"cyclonedx-bom==\S+\s.*cyclonedx-py environment --output-file /opt/advtex/", text, re.DOTALL)
        assert "COPY --from=build" in last
        assert "pip" not in last

    @pytest.mark.parametrize("file", DOCKERFILES, ids=lambda file: file.stem)
    def test_an_image_sets_variables_that_are_read(self, file: Path) -> None:
        named = set(re.findall(r"ADVTEX_\w+", file.read_text()))
        assert named <= known_variables(SETTINGS[file.name.partition(".")[0]])

    def test_the_context_holds_what_is_copied(self) -> None:
        kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
        assert kept == {*ROOMS, "pyproject.toml", "constraints.txt", "README.md", "LICENSE"}

    def test_a_worker_is_healthy_while_redis_knows_it(self, redis_url: str, tmp_path: Path) -> None:
        text = (ROOT / "docker" / "worker.Dockerfile").read_text()
        check = re.search(r"^HEALTHCHECK.*\n +CMD (\[.*\])$", text, re.MULTILINE)
        assert check is not None
        environment = dict(os.environ) | {"ADVTEX_REDIS_URL": redis_url, "ADVTEX_DATA_DIR": str(tmp_path)}

        def exit_code() -> int:
            command = [sys.executable, *json.loads(check[1])[1:]]
            return subprocess.run(command, env=environment, stderr=subprocess.PIPE, timeout=60, check=False).returncode

        assert exit_code() == 1
        with redis.Redis.from_url(redis_url) as connection:
            queue = JobQueue(connection)
            queue.announce(f"{socket.gethostname()}-1", 8)
            assert exit_code() == 0
            queue.depart(f"{socket.gethostname()}-1")
        assert exit_code() == 1


class TestCompose:
    def test_it_follows_the_schema(self) -> None:
        assert tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", "compose.yaml").returncode == 0

    def test_variables_are_read_by_whom_they_are_given_to(self) -> None:
        for name, service in COMPOSE["services"].items():
            given = {key for key in service.get("environment", {}) if key.startswith("ADVTEX_")}
            assert given <= (known_variables(SETTINGS[name]) if name in SETTINGS else set()), name
            assert bool(given) == (name in SETTINGS), name

    def test_the_services_settings_are_valid_and_alike(self, monkeypatch: pytest.MonkeyPatch) -> None:
        read = {}
        for name, kind in SETTINGS.items():
            with monkeypatch.context() as patch:
                for key, value in COMPOSE["services"][name]["environment"].items():
                    patch.setenv(key, re.sub(r"\$\{(\w+):\?[^}]*\}", r"\1-secret", value))
                read[name] = kind()
        for field in ("database", "redis_url", "blobs", "lease_seconds"):
            assert getattr(read["server"], field) == getattr(read["worker"], field)
        assert read["server"].database == "postgresql+psycopg://advtex:POSTGRES_PASSWORD-secret@postgres/advtex"

    def test_server_and_workers_see_the_same_scans(self) -> None:
        mounts, roots = set(), set()
        for name in SETTINGS:
            service = COMPOSE["services"][name]
            mounts |= {entry for entry in service["volumes"] if ":/scans:" in entry}
            assert sum(":/scans:" in entry for entry in service["volumes"]) == 1, name
            roots.add(service["environment"]["ADVTEX_REFERENCE_ROOTS"])
        assert mounts == {"${ADVTEX_SCANS:-./scans}:/scans:ro"}
        (root,) = roots
        assert re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", root) == "file:///scans"

    def test_secrets_are_required_and_never_written_down(self) -> None:
        text = (ROOT / "compose.yaml").read_text()
        used = re.findall(r"\$\{(\w+_PASSWORD)([^}]*)\}", re.sub(r"^ *#.*", "", text, flags=re.MULTILINE))
        assert {name for name, _ in used} == {"POSTGRES_PASSWORD", "REDIS_PASSWORD", "MINIO_PASSWORD"}
        assert all(rest.startswith(":?") for _, rest in used)
        for service in COMPOSE["services"].values():
            for key, value in service.get("environment", {}).items():
                assert "${" in value or not re.search("PASSWORD|SECRET|AUTH", key)

    def test_everything_is_pinned_healthy_before_it_is_needed_and_restarted(self) -> None:
        services = COMPOSE["services"]
        for name, service in services.items():
            assert re.search(r":\D*\d+\.?\d*", service["image"]), f"{name} has no version"
            for needed, how in service.get("depends_on", {}).items():
                ends = "restart" not in services[needed]
                assert how["condition"] == ("service_completed_successfully" if ends else "service_healthy")
                assert ends or "build" in services[needed] or "healthcheck" in services[needed]

    def test_redis_forgets_nothing_by_itself(self) -> None:
        lines = COMPOSE["configs"]["redis"]["content"].splitlines()
        assert {"appendonly yes", "maxmemory-policy noeviction"} <= set(lines)

    def test_a_worker_has_a_gpu_unless_the_profile_says_that_there_is_none(self) -> None:
        gpu, cpu = (dict(COMPOSE["services"][name]) for name in ("worker", "worker-cpu"))
        (device,) = gpu.pop("deploy")["resources"]["reservations"]["devices"]
        assert device["capabilities"] == ["gpu"]
        assert cpu.pop("deploy") == {}
        assert (gpu.pop("profiles"), cpu.pop("profiles")) == (["gpu"], ["cpu"])
        assert gpu == cpu, "nothing else tells them apart"
        others = [name for name, service in COMPOSE["services"].items() if "profiles" not in service]
        assert {"server", "postgres", "redis", "minio", "bucket"} == set(others)

    def test_a_worker_has_time_for_its_checkpoint(self) -> None:
        worker = COMPOSE["services"]["worker"]
        grace = float(worker["environment"]["ADVTEX_GRACE_SECONDS"])
        assert float(worker["stop_grace_period"].removesuffix("s")) > grace


@pytest.mark.slow
def test_the_light_client_needs_nothing_heavy(tmp_path: Path) -> None:
    build = tool("pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, ROOT)
    assert build.returncode == 0
    (wheel,) = tmp_path.glob("advtex-*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    binaries = tmp_path / "venv" / "bin"
    install = [binaries / "python", "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel]
    subprocess.run(install, check=True, timeout=240)

    def run(name: str, *arguments: object) -> str:
        command = [binaries / name, *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True, timeout=60).stdout

    assert "submit" in run("advtex-client", "--help")
    assert "ok" in run("advtex-client", "check", "--json", write_scan(tmp_path / "scan"))
    absent = f"import importlib.util as u; print([name for name in {HEAVY} if u.find_spec(name)])"
    assert run("python", "-c", absent).strip() == "[]"
    shipped = set(zipfile.ZipFile(wheel).namelist())
    sources = {
        path.relative_to(ROOT / room).as_posix()
        for room in ROOMS
        for path in (ROOT / room).glob("advtex_*/**/*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert sources <= shipped


@pytest.mark.slow
class TestDemo:
    """In a folder of its own: the script works beside wherever it lies."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / ".ci").mkdir()
        shutil.copy(ROOT / ".ci" / "demo", tmp_path / ".ci")
        return tmp_path

    def start(self, folder: Path, scan: Path) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [folder / ".ci" / "demo", scan],
            env=dict(os.environ)
            | {
                "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
                "SIZE": "96x72",
                "ADVTEX_URL": "http://no",
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def test_it_prints_what_it_made_and_leaves_no_process(self, folder: Path) -> None:
        # The command that the script finds first asks for few steps: they take most of the demo's time.
        command = folder / ".venv" / "bin" / "advtex-client"
        command.parent.mkdir(parents=True)
        command.write_text(f'#!/bin/sh\nexec "{Path(sys.executable).with_name("advtex-client")}" "$@" --steps 60\n')
        command.chmod(0o755)
        with self.start(folder, write_zip(folder / "scan.zip", write_scan(folder / "scan"))) as demo:
            assert demo.stdout is not None
            said, processes = [], set[int]()
            for line in demo.stdout:
                said.append(line)
                processes |= set(process_tree(demo.pid))
            assert demo.wait(60) == 0, "".join(said)
        assert len(processes) > 5
        wait_until(lambda: not any(psutil.pid_exists(pid) for pid in processes))
        paths = [folder / line.split()[-1] for line in said[-6:]]
        names = ["model.glb", "model_mobile.glb", "model.usdz", "model.obj", "index.html", "comparison.png"]
        assert [path.name for path in paths] == names, "".join(said)
        assert all(path.stat().st_size > 50 for path in paths)
        assert sorted(path.name for path in (folder / "demo").iterdir()) == ["result", "service.log"]

    def test_ctrl_c_stops_everything(self, folder: Path) -> None:
        with self.start(folder, write_zip(folder / "scan.zip", write_scan(folder / "scan"))) as demo:
            assert demo.stdout is not None
            said = []
            for line in demo.stdout:
                said.append(line)
                # Of the stages, which pass quickly, only some are printed.
                if re.search(r"^job \w+: (?!checking|queued)", line):
                    break
            processes = process_tree(demo.pid)
            assert len(processes) > 5, "".join(said)
            os.killpg(demo.pid, signal.SIGINT)
            assert demo.wait(60) == 130
        wait_until(lambda: not any(psutil.pid_exists(pid) for pid in processes))
        assert [path.name for path in (folder / "demo").iterdir()] == ["service.log"]

    def test_a_scan_that_is_none_fails_and_leaves_nothing(self, folder: Path) -> None:
        (folder / "scan.zip").write_text("no scan")
        with self.start(folder, folder / "scan.zip") as demo:
            output, _ = demo.communicate(timeout=60)
            assert demo.returncode == 4, output
        assert "done in" not in output
        assert [path.name for path in (folder / "demo").iterdir()] == ["service.log"]
