"""Several jobs on one GPU and several GPUs in one worker: slots found, shared out, locked, and served by processes.

The GPUs are told by an `nvidia-smi` of the test's own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from live_service import process_tree, wait_until

from advtex_contract.options import JobOptions
from advtex_store.memory_estimate import GIB
from advtex_worker.adapt import texture_config
from advtex_worker.locks import first_lock, lock_paths
from advtex_worker.memory import Gpu, list_gpus, usable_cores
from advtex_worker.settings import WorkerSettings
from advtex_worker.slots import Slot, find_slots, hold, settings_of

TWO = "GPU-aaaa, 24576\nGPU-bbbb, 8192\n"


@pytest.fixture
def gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a tool that tells of two GPUs, first in the PATH; locks lie there too."""
    folder = tmp_path / "bin"
    folder.mkdir()
    tool = folder / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\nprintf '{TWO}'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def settings(**values: object) -> WorkerSettings:
    return WorkerSettings.model_validate({"data_dir": Path("/nowhere"), **values})


@pytest.mark.parametrize(
    ("visible", "found"),
    [
        (None, ["GPU-aaaa", "GPU-bbbb"]),
        ("1,0", ["GPU-bbbb", "GPU-aaaa"]),
        ("GPU-b", ["GPU-bbbb"]),
        ("0,7,1", ["GPU-aaaa"]),
        ("", []),
        ("MIG-1234", []),
    ],
)
def test_only_visible_gpus_count(
    gpus: Path, monkeypatch: pytest.MonkeyPatch, visible: str | None, found: list[str]
) -> None:
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert [gpu.uuid for gpu in list_gpus()] == found


def test_a_machine_has_a_slot_for_each_gpu_and_job(gpus: Path) -> None:
    a, b = Gpu("GPU-aaaa", 24 * GIB), Gpu("GPU-bbbb", 8 * GIB)
    assert list_gpus() == [a, b]
    assert find_slots(settings(device="auto")) == [Slot(a.uuid, a.memory_bytes), Slot(b.uuid, b.memory_bytes)]
    shared = [Slot("GPU-aaaa", 12 * GIB), Slot("GPU-bbbb", 4 * GIB)]
    assert find_slots(settings(device="auto", jobs_per_gpu=2)) == shared * 2
    assert find_slots(settings(device="cuda", jobs_per_gpu=2)) == shared[:1] * 2
    assert find_slots(settings(device="cuda:1", jobs_per_gpu=2)) == shared[1:] * 2
    assert find_slots(settings(device="auto", jobs_per_gpu=2, gpu="GPU-bbbb")) == shared[1:], "a slot's own process"
    assert [slot.memory_bytes for slot in find_slots(settings(memory_bytes=5 * GIB))] == [5 * GIB] * 2


def test_without_a_gpu_there_is_one_slot(gpus: Path) -> None:
    assert [slot.gpu for slot in find_slots(settings(device="cpu", jobs_per_gpu=4))] == [None]
    (gpus / "nvidia-smi").write_text("#!/bin/sh\nexit 9\n")
    assert [slot.gpu for slot in find_slots(settings(device="auto", jobs_per_gpu=4))] == [None]
    assert find_slots(settings(device="cuda:3"))[0].memory_bytes > 0


def test_slots_share_threads_and_memory() -> None:
    slot = Slot("GPU-aaaa", 12 * GIB)
    own = settings_of(slot, settings(jobs_per_gpu=2), 4)
    assert (own.gpu, own.memory_bytes) == ("GPU-aaaa", 12 * GIB)
    assert own.threads == max(1, usable_cores() // 4)
    assert settings_of(slot, settings(jobs_per_gpu=2, threads=3), 4).threads == 3
    assert settings_of(slot, settings(), 1).memory_bytes is None, "alone on a GPU it may take what is free"


def test_of_all_workers_no_more_hold_a_gpu_than_may(gpus: Path) -> None:
    slot, waits = Slot("GPU-aaaa", GIB), list[float]()
    one, two = hold(slot, 2, waits.append), hold(slot, 2, waits.append)
    assert one is not None
    assert two is not None
    assert waits == []

    def leave(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            one.close()

    third = hold(slot, 2, leave)
    assert len(waits) == 3
    assert third is not None
    assert first_lock(lock_paths("slot-GPU-aaaa", 2)) is None
    assert hold(Slot(None, GIB), 2, leave) is None
    for lock in (two, third):
        lock.close()


def test_the_share_reaches_the_engine() -> None:
    assert texture_config(JobOptions(), "cuda", 7 * GIB).memory_bytes == 7 * GIB
    assert texture_config(JobOptions(), "cuda").memory_bytes is None


SLEEPER = "import os, sys, time; open(sys.argv[1], 'a').write(os.environ['ADVTEX_GPU'] + '\\n'); time.sleep({seconds})"
SUPERVISOR = """
import sys
from pathlib import Path
from advtex_store import supervision
from advtex_worker import slots
from advtex_worker.leaving import Departure, Stay
from advtex_worker.settings import WorkerSettings
supervision.RESTART_SECONDS = (0.1,)
settings = WorkerSettings(data_dir=Path("/nowhere"))
departure = Departure(Stay(), settings.grace_seconds)
slots.supervise([sys.executable, "-c", sys.argv[2], sys.argv[1]], slots.find_slots(settings), settings, departure)
"""


@pytest.mark.parametrize("seconds", [60, 0])
def test_every_slot_has_a_process_that_is_started_again_and_goes_with_it(
    gpus: Path, tmp_path: Path, seconds: int
) -> None:
    told = tmp_path / "told"
    command = [sys.executable, "-c", SUPERVISOR, str(told), SLEEPER.format(seconds=seconds)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as supervisor:
        try:
            wait_until(lambda: told.exists() and len(told.read_text().split()) >= (2 if seconds else 5), 40)
            started = told.read_text().split()
            family = process_tree(supervisor.pid)
        finally:
            supervisor.terminate()
    assert supervisor.returncode == 0
    assert set(started) == {"GPU-aaaa", "GPU-bbbb"}
    assert (len(family), len(started)) == (3, 2) or not seconds
    assert not any(Path(f"/proc/{pid}").exists() for pid in family[1:])
