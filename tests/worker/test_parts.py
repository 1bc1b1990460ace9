"""The small parts of the worker, each against what it promises to its neighbours."""

from __future__ import annotations

import importlib
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from advtex_contract.jobs import Progress
from advtex_contract.options import JobOptions, Preset, chosen_options
from advtex_contract.stages import STAGE_LABELS
from advtex_engine.core import config as engine
from advtex_engine.core.errors import OptionError
from advtex_engine.core.monitor import STAGES
from advtex_options import described
from advtex_options.methods import known_methods
from advtex_store.errors import StaleAttempt
from advtex_store.queue import TASK
from advtex_store.records import Lease
from advtex_worker import lease, memory
from advtex_worker.adapt import texture_config
from advtex_worker.events import (
    CheckpointEvent,
    DiskFullEvent,
    Event,
    FailedEvent,
    FinishedEvent,
    ProgressEvent,
    StageEvent,
    StoppedEvent,
    parse_event,
)
from advtex_worker.lease import Ending, LeaseKeeper
from advtex_worker.locks import try_lock
from advtex_worker.memory import usable_cores, usable_memory
from advtex_worker.progress import ProgressTracker


def test_the_task_that_the_queue_names_exists() -> None:
    module, _, name = TASK.rpartition(".")
    assert callable(getattr(importlib.import_module(module), name))


def test_the_engine_that_the_runner_names_exists() -> None:
    runner = importlib.import_module("advtex_worker.runner")
    assert callable(runner._resolved(runner.ENGINE))


def test_neither_worker_nor_work_horse_imports_torch() -> None:
    code = "import advtex_worker.main, sys; sys.exit('torch' in sys.modules or 'cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_presets_of_users_and_engine_are_the_same() -> None:
    assert {preset.value for preset in Preset} == {"auto", *engine.PRESETS}


@pytest.mark.parametrize("name", [name for name, about in described().items() if about.low is not None])
def test_engine_and_contract_refuse_in_the_same_words(name: str) -> None:
    about = described()[name]
    assert about.low is not None
    assert about.high is not None
    for bound, beyond in ((about.low, about.low - 1), (about.high, about.high + 1)):
        right, wrong = (f"{bound}x{bound}", f"{beyond}x{beyond}") if name == "size" else (bound, beyond)
        texture_config(chosen_options({name: right}), "cpu")
        with pytest.raises(ValueError, match=f"{name} .* is out of bounds; give ") as told:
            chosen_options({name: wrong})
        with pytest.raises(OptionError) as refused:
            engine.TextureConfig(**{name: (beyond, beyond) if name == "size" else beyond})  # type: ignore[arg-type]
        assert str(refused.value) == str(told.value)


def test_a_method_that_this_worker_lacks_is_refused_with_the_remedy() -> None:
    with pytest.raises(OptionError, match=r"method 'magic' is unknown; .*, or install the package that brings it"):
        texture_config(JobOptions(method="magic"), "cpu")


@given(
    st.sampled_from(Preset),
    st.sampled_from(sorted(known_methods())),
    st.integers(64, 4096),
    st.integers(64, 4096),
    st.integers(2, 1000),
    st.integers(0, 2**31 - 1),
    st.none() | st.integers(100, 2_000_000),
    st.none() | st.integers(2, 2000),
)
def test_every_option_arrives(
    preset: Preset,
    method: str,
    width: int,
    height: int,
    holdout: int,
    seed: int,
    face_budget: int | None,
    max_views: int | None,
) -> None:
    options = JobOptions(
        preset=preset,
        method=method,
        width=width,
        height=height,
        holdout=holdout,
        seed=seed,
        face_budget=face_budget,
        max_views=max_views,
        steps=9,
        layout="tum",
    )
    config = texture_config(options, "cuda:1")
    assert (config.preset, config.method) == (preset.value, method)
    assert (config.size, config.holdout, config.seed) == ((width, height), holdout, seed)
    assert (config.steps, config.device, config.max_texture_size) == (9, "cuda:1", options.max_texture_size)
    assert config.layout == "tum"
    assert config.face_budget == (engine.TextureConfig().face_budget if face_budget is None else face_budget)
    assert config.max_views == (engine.TextureConfig().max_views if max_views is None else max_views)


@pytest.mark.parametrize(
    "event",
    [
        StageEvent(stage="atlas"),
        StageEvent(stage="atlas", seconds=1.5),
        ProgressEvent(step=1, steps=2, losses={"l1": 0.5}),
        CheckpointEvent(files={"a/b": Path("/x/1")}),
        DiskFullEvent(),
        FinishedEvent(),
        StoppedEvent(),
        FailedEvent(code="engine_error", message="two\nlines"),
    ],
)
def test_events_survive_the_line(event: Event) -> None:
    assert event.line().count("\n") == 1
    assert parse_event(event.line()) == event


@pytest.mark.parametrize("line", ["", "{}", '{"kind": "dance"}', '{"kind": "stage"}', "Epoch 1: loss 0.5"])
def test_other_lines_are_no_events(line: str) -> None:
    with pytest.raises(ValueError, match="validation error"):
        parse_event(line)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_eta_counts_only_steps_of_this_attempt() -> None:
    clock = Clock()
    tracker = ProgressTracker(Progress(), clock)
    tracker.stage(StageEvent(stage="optimization"))
    tracker.progress(ProgressEvent(step=3000, steps=4000))  # resumed
    assert tracker.view.eta_seconds is None
    clock.now += 10.0
    tracker.progress(ProgressEvent(step=3100, steps=4000))
    assert tracker.view.eta_seconds == pytest.approx(90.0)
    tracker.stage(StageEvent(stage="export"))
    assert tracker.view.eta_seconds is None


def test_the_contract_has_words_for_the_engines_stages() -> None:
    assert tuple(STAGE_LABELS) == STAGES


@given(st.lists(st.tuples(st.sampled_from(STAGES), st.integers(0, 1_000_000)), max_size=20))
def test_reached_grows_with_stage_and_step_and_never_shrinks(moves: list[tuple[str, int]]) -> None:
    tracker = ProgressTracker(Progress())
    best = (0, 0)
    for stage, step in moves:
        before = tracker.reached
        tracker.stage(StageEvent(stage=stage))
        tracker.progress(ProgressEvent(step=step, steps=1_000_000))
        grew = (STAGES.index(stage), step) > best
        best = max(best, (STAGES.index(stage), step))
        assert (tracker.reached > before) == grew


def test_the_seconds_of_stages_are_those_of_all_attempts() -> None:
    clock = Clock()
    tracker = ProgressTracker(Progress(stage_seconds={"ingest": 4.0, "optimization": 100.0}), clock)
    assert tracker.view.stage_seconds == {"ingest": 4.0, "optimization": 100.0}, "nothing is lost before the first word"
    tracker.stage(StageEvent(stage="atlas"))
    tracker.stage(StageEvent(stage="atlas", seconds=2.0))
    tracker.stage(StageEvent(stage="optimization"))
    for _ in range(3):
        clock.now += 10.0
        tracker.progress(ProgressEvent(step=3000, steps=4000))
    assert tracker.view.stage_seconds == {"ingest": 4.0, "atlas": 2.0, "optimization": 130.0}, "also if it dies now"
    tracker.stage(StageEvent(stage="optimization", seconds=31.0))
    assert tracker.view.stage_seconds["optimization"] == 131.0


class FakeRecords:
    """Answers heartbeats as it is told."""

    lease_seconds = 0.2

    def __init__(self) -> None:
        self.answer: Lease | Exception = Lease(math.inf, False)
        self.heard: list[tuple[Any, int, str | None]] = []
        self.stages: list[str] = []
        self.looks = 0

    def heartbeat(
        self,
        job_id: str,
        attempt: int,
        progress: Progress | None = None,
        *,
        stages: Sequence[Progress],
        reached: int,
        log_tail: str | None,
        waiting_reason: str,
        moved: Mapping[str, int],
    ) -> Lease:
        self.heard.append((progress, reached, log_tail))
        self.stages += [told.stage for told in stages]
        return self.lease(job_id, attempt)

    def lease(self, job_id: str, attempt: int) -> Lease:
        self.looks += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def keeper(records: FakeRecords, on_ending: Callable[[Ending], object], tail: str = "", **changed: Any) -> LeaseKeeper:
    options = {"interval": 60.0, "show": lambda *_: None} | changed
    return LeaseKeeper(records, "job", 1, on_ending=on_ending, log_tail=lambda: tail, **options)  # type: ignore[arg-type]


def test_a_database_that_is_away_costs_nothing_until_the_lease_runs_out() -> None:
    records, ended = FakeRecords(), threading.Event()
    records.lease_seconds = 0.5
    kept = keeper(records, lambda _: ended.set(), interval=0.01)
    began = time.monotonic()
    kept.start()
    assert not ended.wait(2 * records.lease_seconds), "the heartbeats renew it"
    records.answer = ConnectionError("no route")
    assert kept.beat()
    assert ended.wait(5.0)
    assert kept.ending is Ending.lost
    assert time.monotonic() - began < 8 * records.lease_seconds
    kept.stop()


def test_a_heartbeat_that_hangs_does_not_hide_the_end_of_the_lease() -> None:
    records, ended, hung = FakeRecords(), threading.Event(), threading.Event()

    def hang(*_: Any, **__: Any) -> Lease:
        hung.wait(20)
        return Lease(math.inf, False)

    records.heartbeat = hang  # type: ignore[method-assign]
    kept = keeper(records, lambda _: ended.set(), interval=0.01)
    kept.start()
    assert ended.wait(5.0)
    hung.set()
    kept.stop()


def test_memory_is_the_smallest_gpus_or_the_machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho GPU-a, 24564\necho GPU-b, 8192\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert usable_memory("auto") == usable_memory("cuda:1") == 8192 << 20
    machine = usable_memory("cpu")
    assert 0 < machine <= psutil.virtual_memory().total
    tool.write_text("#!/bin/sh\nexit 9\n")
    assert usable_memory("auto") == machine


@pytest.mark.parametrize(
    ("share", "quota", "cores"),
    [
        ("max 100000", None, 64),
        ("400000 100000", None, 4),
        ("160000 100000", None, 2),
        ("20000 100000", None, 1),
        ("9900000 100000", None, 64),
        (None, "-1", 64),
        (None, "300000", 3),
        (None, None, 64),
        ("nonsense", None, 64),
    ],
)
def test_a_container_s_share_of_the_cores_is_kept_to(
    share: str | None, quota: str | None, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("cpu.max", "quota", "period")
    for name, text in zip(names, (share, quota, "100000"), strict=True):
        if text is not None:
            (tmp_path / name).write_text(f"{text}\n")
    monkeypatch.setattr(memory, "CPU_SHARE", tmp_path / "cpu.max")
    monkeypatch.setattr(memory, "CPU_SHARE_V1", (tmp_path / "quota", tmp_path / "period"))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    assert usable_cores() == cores


def test_a_stale_attempt_is_told_once_and_overrules_a_cancel() -> None:
    records, endings = FakeRecords(), []
    kept = keeper(records, endings.append)
    records.answer = Lease(math.inf, True)
    kept.beat()
    kept.beat()
    records.answer = StaleAttempt("moved on")
    kept.beat()
    kept.beat()
    kept.end(Ending.preempt)
    assert endings == [Ending.cancel, Ending.lost]
    assert kept.ending is Ending.lost


def test_an_attempt_that_is_being_ended_has_no_lease_to_lose() -> None:
    records, endings = FakeRecords(), []
    kept = keeper(records, endings.append)
    records.answer = StaleAttempt("it has succeeded")
    with capture_logs() as lines:
        with kept.closing():
            assert not kept.beat()
        kept.turn()
    assert (endings, lines) == ([], [])


def test_an_attempt_whose_end_could_not_be_recorded_can_still_be_lost() -> None:
    records, endings = FakeRecords(), []
    kept = keeper(records, endings.append)
    with pytest.raises(ConnectionError), kept.closing():
        raise ConnectionError("no route")
    records.answer = StaleAttempt("moved on")
    kept.beat()
    assert endings == [Ending.lost]


def test_the_row_is_written_every_few_seconds_and_watchers_see_more(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(lease, "_now", lambda: now[0])
    records, endings, shown = FakeRecords(), [], []
    records.lease_seconds = 60.0
    kept = keeper(records, endings.append, show=lambda progress, paused: shown.append((progress, paused)))
    stages = ["ingest", "atlas", "atlas", "optimization"]
    told = []
    for turn in range(60):
        progress = Progress(stage=stages[min(turn // 3, 3)], step=turn // 2)
        kept.report(progress, turn)
        kept.paused = "no room" if turn == 41 else ""
        told.append((progress, kept.paused))
        kept.turn()
        now[0] += 0.5
    assert records.looks == 60, "a cancel is seen at every turn"
    assert [reached for _, reached, _ in records.heard] == [10, 20, 30, 40, 50], "once in five seconds"
    assert records.stages == ["ingest", "atlas", "optimization"], "also those that were left before"
    assert shown == [news for before, news in pairwise([None, *told]) if news != before]
    records.answer = Lease(math.inf, True)
    kept.turn()
    assert (endings, len(records.heard)) == ([Ending.cancel], 6)


def test_what_did_not_get_through_is_told_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(lease, "_now", lambda: now[0])
    records = FakeRecords()
    records.lease_seconds = 60.0
    kept = keeper(records, print)
    kept.report(Progress(stage="ingest"), 1)
    now[0] += 6.0
    records.answer = ConnectionError("no route")
    kept.turn()
    kept.report(Progress(stage="atlas"), 2)
    records.answer, records.stages = Lease(math.inf, False), []
    kept.turn()
    kept.turn()
    assert (len(records.heard), records.stages) == (2, ["ingest", "atlas"])


def test_progress_and_a_changed_log_travel_with_the_heartbeat() -> None:
    records = FakeRecords()
    kept = keeper(records, print, tail="line 1")
    kept.report(Progress(stage="atlas"), 7)
    kept.beat()
    kept.beat()
    assert records.heard == [(Progress(stage="atlas"), 7, "line 1"), (Progress(stage="atlas"), 7, None)]


def test_a_device_lock_is_exclusive_and_free_again(tmp_path: Path) -> None:
    path = tmp_path / "gpu.lock"
    held = try_lock(path)
    assert held is not None
    assert try_lock(path) is None
    held.close()
    again = try_lock(path)
    assert again is not None
    again.close()


def test_the_cpu_needs_no_lock() -> None:
    devices = importlib.import_module("advtex_worker.devices")
    assert devices.acquire("cpu", lambda: True) == ("cpu", None)


@pytest.mark.parametrize(("wanted", "taken"), [("auto", "cpu"), ("cuda", "cuda"), ("cuda:3", "cuda:3")])
def test_without_a_gpu_auto_is_the_cpu_and_the_engine_judges_the_rest(
    monkeypatch: pytest.MonkeyPatch, wanted: str, taken: str
) -> None:
    devices = importlib.import_module("advtex_worker.devices")
    monkeypatch.setattr(devices.torch.cuda, "is_available", lambda: False)
    assert devices.acquire(wanted, lambda: False) == (taken, None)


class TwoGpus:
    """What the lock asks of `torch.cuda`."""

    def is_available(self) -> bool:
        return True

    def device_count(self) -> int:
        return 2

    def get_device_properties(self, index: int) -> SimpleNamespace:
        return SimpleNamespace(uuid=f"test-{os.getpid()}-{index}")


def test_auto_takes_the_gpu_that_is_free_and_waits_when_none_is(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = importlib.import_module("advtex_worker.devices")
    monkeypatch.setattr(devices.torch, "cuda", TwoGpus())
    monkeypatch.setattr(devices, "POLL_SECONDS", 0.01)
    first, second = devices.acquire("auto", lambda: False), devices.acquire("auto", lambda: False)
    assert (first[0], second[0]) == ("cuda:0", "cuda:1")
    asked = iter([False, False, True])
    assert devices.acquire("auto", lambda: next(asked)) is None, "a stop is heard while waiting"
    first[1].close()
    again = devices.acquire("cuda", lambda: False)
    assert again[0] == "cuda:0"
    for lock in (second[1], again[1]):
        lock.close()
        Path(lock.name).unlink()


def test_a_gpu_takes_as_many_jobs_as_it_may_and_the_emptiest_comes_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    devices = importlib.import_module("advtex_worker.devices")
    monkeypatch.setattr(devices.torch, "cuda", TwoGpus())
    monkeypatch.setattr(devices, "POLL_SECONDS", 0.01)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    taken = [devices.acquire("auto", lambda: False, 2) for _ in range(4)]
    assert [name for name, _ in taken] == ["cuda:0", "cuda:1", "cuda:0", "cuda:1"]
    asked = iter([False, False, True])
    assert devices.acquire("auto", lambda: next(asked), 2) is None, "never more than two on either"
    taken[3][1].close()
    again = devices.acquire("auto", lambda: False, 2)
    assert again[0] == "cuda:1"
    for _, lock in (*taken, again):
        lock.close()
