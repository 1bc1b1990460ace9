"""Several jobs on one GPU and several GPUs in one worker, with real workers on GPUs that only `nvidia-smi` tells of."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import LiveService, live_service, process_tree, wait_until

from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveService]:
    """On two GPUs of 24 and 8 GiB, two jobs each; the locks lie in the test's folder."""
    tools = tmp_path / "bin"
    tools.mkdir()
    tool = tools / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho GPU-aaaa, 24576\necho GPU-bbbb, 8192\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tools), prepend=":")
    monkeypatch.setenv("TMPDIR", str(tools))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    for name in ("HOME", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    slots = {"ADVTEX_DEVICE": "auto", "ADVTEX_JOBS_PER_GPU": "2"}
    # nobody dies here: the lease outlasts nine processes that begin at once on a busy machine
    with live_service(tmp_path, settings={**slots, "ADVTEX_LEASE_SECONDS": "20"}) as running:
        yield running


def runners(pid: int) -> list[str]:
    """The GPUs that the runners below a worker see."""
    found = []
    for descendant in process_tree(pid):
        try:
            if b"advtex_worker.runner" in Path(f"/proc/{descendant}/cmdline").read_bytes():
                variables = Path(f"/proc/{descendant}/environ").read_bytes().split(b"\0")
                found += [entry.decode() for entry in variables if entry.startswith(b"CUDA_VISIBLE_DEVICES=")]
        except OSError:  # it has just ended
            continue
    return sorted(name.partition("=")[2] for name in found)


@pytest.mark.slow
def test_gpus_have_as_many_jobs_as_they_may_and_others_step_in(service: LiveService, scan: Path) -> None:
    queue, records = service.store.queue, service.store.records
    first = service.start_worker("stepping")
    wait_until(lambda: len(queue.workers()) == 4, 60)
    assert [(found.gib, found.workers) for found in queue.classes()] == [(4, 2), (12, 2)], "a job has half of a GPU"
    second = service.start_worker("stepping")
    with service.client() as client:
        large = client.submit(scan, JobOptions(steps=9_000, width=2400, height=1800, preset="full")).id
        jobs = [client.submit(scan, JobOptions(steps=9_000, seed=seed)).id for seed in range(5)]
        wait_until(lambda: all(records.job(job).state != JobState.checking for job in (large, *jobs)), 60)
        wait_until(lambda: len(runners(first.pid)) == 4, 60)
        assert runners(first.pid) == ["GPU-aaaa", "GPU-aaaa", "GPU-bbbb", "GPU-bbbb"]
        assert records.job(large).memory_bytes > 4 << 30, "the smaller GPU's slots are not for it"
        states = [records.job(job).state for job in (large, *jobs)]
        assert (states.count(JobState.running), states.count(JobState.queued)) == (4, 2)
        assert runners(second.pid) == [], "it waits without a job"
        assert len(queue.workers()) == 4
        os.kill(first.pid, signal.SIGTERM)
        assert first.wait(60) == 0
        wait_until(lambda: len(runners(second.pid)) == 4, 60)
