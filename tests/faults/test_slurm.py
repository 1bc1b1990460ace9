"""The batch script for SLURM with a real worker in the middle of a job: `srun` and `scontrol` are stand-ins."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from live_service import SUPPORT, LiveService, process_tree, wait_until
from outcomes import assert_done_once

from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions
from advtex_worker.leaving import AGAIN

SCRIPT = Path(__file__).parents[2] / "docker" / "slurm" / "advtex.sbatch"
STEPS = 9000

# Signals every process of its step once there is a file, as `srun` does at the time of `--signal`.
SRUN = f"""#!{sys.executable}
import os, signal, subprocess, sys, time
from contextlib import suppress
from pathlib import Path
from live_service import process_tree
step, notice = subprocess.Popen(sys.argv[1:]), Path(os.environ["NOTICE"])
while step.poll() is None:
    if notice.exists():
        notice.unlink()
        for pid in process_tree(step.pid):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGUSR1)
    time.sleep(0.05)
sys.exit(step.returncode)
"""
SCONTROL = '#!/bin/sh\necho "$@" >> "$REQUEUED"\n'
WORKER = f'#!/bin/sh\nexec {sys.executable} {SUPPORT / "run_worker.py"} leisurely "$@"\n'


@pytest.fixture
def service(service: LiveService, tmp_path: Path) -> LiveService:
    """With what a task of SLURM finds in its environment."""
    tools, settings = tmp_path / "tools", tmp_path / "worker.env"
    tools.mkdir()
    for name, text in {"srun": SRUN, "scontrol": SCONTROL, "advtex-worker": WORKER}.items():
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    data = service.folder / "data"
    places = {"ADVTEX_DATABASE_URL": f"sqlite:///{data}/advtex.db", "ADVTEX_BLOB_URL": (data / "blobs").as_uri()}
    settings.write_text("".join(f"{name}={value}\n" for name, value in places.items()))
    service.environment |= {
        "PATH": f"{tools}:{service.environment['PATH']}",
        "TMPDIR": str(tmp_path),
        "SLURM_JOB_ID": "4711",
        "SLURM_CPUS_PER_TASK": "1",
        "ADVTEX_ENV_FILE": str(settings),
        "ADVTEX_CACHE_DIR": str(tmp_path / "cache"),
        "ADVTEX_LEASE_SECONDS": "60",
        "ADVTEX_ENGINE_HURRY": str(tmp_path / "hurry"),
        "NOTICE": str(tmp_path / "notice"),
        "REQUEUED": str(tmp_path / "requeued"),
    }
    return service


def start_task(service: LiveService) -> subprocess.Popen[bytes]:
    return service._start(["bash", str(SCRIPT)])


@pytest.mark.slow
def test_a_task_whose_time_is_up_gives_its_job_back_and_is_queued_again(
    service: LiveService, scan: Path, tmp_path: Path
) -> None:
    with service.client() as client:
        job_id = client.submit(scan, JobOptions(steps=STEPS)).id
        task = start_task(service)
        wait_until(lambda: client.get_job(job_id).progress.step > 20, 90)
        tree = process_tree(task.pid)
        (tmp_path / "notice").touch()
        assert task.wait(90) == AGAIN
        assert (tmp_path / "requeued").read_text() == "requeue 4711\n"
        row = service.store.records.job(job_id)
        assert (row.state, row.attempt, row.deaths) == (JobState.preempted, 2, 0)
        assert not any(process_tree(pid) for pid in tree)
        assert not (tmp_path / "advtex-4711").exists(), "nothing stays on the node"
        (tmp_path / "hurry").touch()
        again = start_task(service)
        state = assert_done_once(service, client, job_id, STEPS)
        assert state["began"][1] >= 20, "it went on from the checkpoint"
        (tmp_path / "notice").touch()
        assert again.wait(90) == AGAIN


def test_a_task_that_cannot_work_is_not_queued_again(service: LiveService, tmp_path: Path) -> None:
    (tmp_path / "worker.env").write_text("ADVTEX_DEVICE=abacus\n")
    assert start_task(service).wait(60) not in (0, AGAIN)
    (tmp_path / "worker.env").unlink()
    assert start_task(service).wait(60) == 1
    assert not (tmp_path / "requeued").exists()


def test_the_signal_comes_early_enough() -> None:
    text = SCRIPT.read_text()
    options = dict(re.findall(r"^#SBATCH --([\w-]+)(?:=(\S+))?$", text, re.MULTILINE))
    name, _, seconds = options["signal"].partition("@")
    (grace,) = re.findall(r"^export ADVTEX_GRACE_SECONDS=(\d+)$", text, re.MULTILINE)
    assert name == "USR1", "to the steps: B: would be the script alone"
    assert float(seconds) > 2 * float(grace) + 30
    assert {"array", "requeue", "open-mode"} <= set(options)
