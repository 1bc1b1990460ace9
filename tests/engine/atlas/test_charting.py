"""Large meshes: charts made by child processes are those of one process; stops and deaths of children."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil
import pytest

from advtex_engine.atlas import charting
from advtex_engine.atlas.charting import Charts, make_charts, pack_charts, split_faces
from advtex_engine.core.errors import EngineError, Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.children import Arrays, run_in_children

HERE = "advtex_engine_children_for_tests"


class StopAfter(Monitor):
    """Asks for a stop as soon as a file is there."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def stop_requested(self) -> bool:
        return self.path.exists()


def rough_sheet(side: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """A square of side x side quads of about one unit of length each, so rough that it takes many charts."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    position = np.stack([x, y, 0.9 * rng.standard_normal(x.shape)], 2).reshape(-1, 3)
    first = np.arange(side * (side + 1)).reshape(side, side + 1)[:, :-1].reshape(-1)
    lower, upper = [first, first + 1, first + side + 1], [first + 1, first + side + 2, first + side + 1]
    return position.astype(np.float32), np.concatenate([np.stack(lower, 1), np.stack(upper, 1)])


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Meshes of a thousand faces are large; parts are of one block each. Children do not see these numbers."""
    monkeypatch.setattr(charting, "LARGE_MESH", 1_000)
    monkeypatch.setattr(charting, "PART_FACES", charting.BLOCK_FACES)


@pytest.fixture
def child_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that children import, and the folder whose files its functions leave."""
    (tmp_path / f"{HERE}.py").write_text(
        "import os, pathlib, signal, time\n"
        "def report(name, folder):\n"
        "    with open(pathlib.Path(str(folder)) / str(name), 'a') as file:\n"
        "        file.write(f'{os.getpid()}\\n')\n"
        "def double(value, folder):\n"
        "    report('done', folder)\n"
        "    return {'value': 2 * value}\n"
        "def hang(folder):\n"
        "    report('started', folder)\n"
        "    time.sleep(1000)\n"
        "def die_once(value, folder):\n"
        "    first = not (pathlib.Path(str(folder)) / str(value)).exists()\n"
        "    report(value, folder)\n"
        "    if first:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return {'value': value}\n"
        "def die(folder):\n"
        "    report('died', folder)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "def fail(folder):\n"
        "    raise ValueError('in the child')\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def reported(path: Path) -> list[int]:
    return [int(line) for line in path.read_text().splitlines()]


def ended(pid: int) -> bool:
    """Whether no such process runs; one that its parent has not asked for yet has ended."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


# Children


def test_results_come_in_the_order_of_the_requests(child_module: Path) -> None:
    folder = np.array(str(child_module))
    requests: list[Arrays] = [{"value": np.arange(count), "folder": folder} for count in range(5)]
    found = run_in_children(f"{HERE}:double", requests, 2, Monitor(), "none")
    assert [one["value"].tolist() for one in found] == [[2 * value for value in range(count)] for count in range(5)]
    assert len(set(reported(child_module / "done"))) == 5


def test_a_child_that_was_killed_is_repeated(child_module: Path) -> None:
    folder = np.array(str(child_module))
    requests: list[Arrays] = [{"value": np.array(value), "folder": folder} for value in range(2)]
    found = run_in_children(f"{HERE}:die_once", requests, 2, Monitor(), "none")
    assert [int(one["value"]) for one in found] == [0, 1]
    assert [len(reported(child_module / str(value))) for value in range(2)] == [2, 2]


def test_a_part_that_kills_its_children_is_an_error_with_the_remedy(child_module: Path) -> None:
    with pytest.raises(EngineError, match=r"die died \(signal 9\), twice on the same part; buy more memory"):
        run_in_children(f"{HERE}:die", [{"folder": np.array(str(child_module))}], 2, Monitor(), "buy more memory")
    assert len(reported(child_module / "died")) == 2


def test_an_error_in_a_child_is_told_and_logged(child_module: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(EngineError, match=r"fail died \(exit status 1\)"):
        run_in_children(f"{HERE}:fail", [{"folder": np.array(str(child_module))}], 1, Monitor(), "none")
    assert "ValueError: in the child" in capfd.readouterr().err


def test_a_stop_ends_the_children(child_module: Path) -> None:
    folder = np.array(str(child_module))
    with pytest.raises(Stopped):
        run_in_children(f"{HERE}:hang", [{"folder": folder}] * 3, 2, StopAfter(child_module / "started"), "none")
    started = reported(child_module / "started")
    assert 1 <= len(started) <= 2
    assert all(ended(pid) for pid in started)


def test_children_end_with_a_parent_that_is_killed(child_module: Path) -> None:
    folder = repr(str(child_module))
    program = (
        "import numpy\n"
        "from advtex_engine.core.monitor import Monitor\n"
        "from advtex_engine.runtime.children import run_in_children\n"
        f"run_in_children('{HERE}:hang', [{{'folder': numpy.array({folder})}}], 1, Monitor(), 'none')\n"
    )
    parent = psutil.Popen([sys.executable, "-c", program])
    while not (child_module / "started").exists() or not reported(child_module / "started"):
        assert parent.poll() is None
        time.sleep(0.02)
    (pid,) = reported(child_module / "started")
    child = psutil.Process(pid)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    assert psutil.wait_procs([child], timeout=30)[1] == []


# Charts


def test_parts_are_coherent_and_hold_every_face_once() -> None:
    position, faces = rough_sheet(40)
    parts = split_faces(position, faces, 250)
    assert sorted(np.concatenate(parts).tolist()) == list(range(len(faces)))
    assert all(len(part) <= 250 and (np.diff(part) > 0).all() for part in parts)
    for part in parts:
        corners = position[faces[part]].reshape(-1, 3)[:, :2]
        assert np.prod(np.ptp(corners, axis=0)) < 2 * len(part)


@pytest.mark.usefixtures("small_parts")
def test_children_make_the_charts_of_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    position, faces = rough_sheet(40)
    apart = make_charts(position, faces, Monitor())
    monkeypatch.setattr(charting, "_cores", lambda: 1)
    assert_same(apart, make_charts(position, faces, Monitor()))
    monkeypatch.setattr(charting, "LARGE_MESH", len(faces))
    together = make_charts(position, faces, Monitor())
    assert np.array_equal(apart.chart, together.chart)
    assert np.array_equal(apart.faces, together.faces)
    assert apart.chart.min() >= 0
    assert apart.chart.max() > 20


def assert_same(one: Charts, other: Charts) -> None:
    assert np.array_equal(one.uv, other.uv)
    assert np.array_equal(one.faces, other.faces)
    assert np.array_equal(one.chart, other.chart)


@pytest.mark.usefixtures("small_parts")
def test_packing_in_a_child_is_packing(monkeypatch: pytest.MonkeyPatch) -> None:
    position, faces = rough_sheet(24)
    charts = make_charts(position, faces, Monitor())
    ((texel, side),) = pack_charts([(charts.uv, charts.faces)], Monitor())
    monkeypatch.setattr(charting, "LARGE_MESH", len(faces))
    ((here, here_side),) = pack_charts([(charts.uv, charts.faces)], Monitor())
    assert side == here_side
    assert np.array_equal(texel, here)


def test_a_child_starts_without_torch() -> None:
    """It takes seconds and hundreds of MB to import, and a mesh may have dozens of children."""
    modules = "advtex_engine.runtime.children, advtex_engine.atlas.charting, advtex_engine.mesh.quadric"
    told = f"import sys, {modules}; print('torch' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"
