"""Engines with the interface of `advtex_engine.pipeline.texture_scan`, each with one way of its own to behave.

They run in the runner's process, which finds them through PYTHONPATH.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError, Problem, ScanError, Stopped
from advtex_engine.core.monitor import Glimpse, Monitor

RESULTS = ("model.obj", "model.mtl", "model.png", "model.glb", "report.json", "previews/side_by_side.png")


def quick(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Does nothing much, and does it well."""
    monitor.stage_started("ingest")
    assert scan.stat().st_size > 0
    monitor.warning(Problem("frame_dropped", "color/9.png", "has no pose", "give it one"))
    monitor.stage_finished("ingest", 0.01, 1 << 20, None)
    monitor.stage_started("optimization")
    for step in range(1, 4):
        monitor.progress(step, 3, {"l1": 1.0 / step, "adversarial": float("nan")})
    monitor.stage_finished("optimization", 0.02, 2 << 20, 3 << 20)
    print("a stray line on stdout")  # must not be taken for an event
    write_results(out, f"seed {config.seed} size {config.size}")


def coarse(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """The real engine; but what it fuses from depth has voxels of 8 cm, and not of 1 cm."""
    from advtex_engine import pipeline
    from advtex_engine.mesh import fusion

    fusion.COARSEST = fusion.FINEST = 0.08
    pipeline.texture_scan(scan, out, config, work=work, resume=resume, monitor=monitor)


def scored(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """As after a run with held-out frames."""
    quick(scan, out, config, work=work, resume=resume, monitor=monitor)
    scores = {"lpips": 0.25, "s3_ratio": 0.9, "band_error": None, "views": 3, "missing": {"x": "y"}}
    (out / "report.json").write_text(json.dumps({"heldout": {"texture": scores, "mean": scores}}))


def stepping(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """`config.steps` steps of 10 ms, a checkpoint every 10; the result depends on every step, made once and in order.

    The history in the state tells where each process began.
    """
    _steps(out, config.steps or 100, work / "state.json", resume, monitor, lambda _step: None)


def leisurely(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Like `stepping`, but once there is a file $ADVTEX_ENGINE_HURRY its steps take no time."""
    hurry = Path(os.environ["ADVTEX_ENGINE_HURRY"])
    pause = lambda: None if hurry.exists() else time.sleep(0.01)  # noqa: E731
    _steps(out, config.steps or 100, work / "state.json", resume, monitor, lambda _step: None, pause)


def _steps(
    out: Path,
    steps: int,
    path: Path,
    resume: bool,
    monitor: Monitor,
    told: Callable[[int], None],
    pause: Callable[[], None] = lambda: time.sleep(0.01),
) -> None:
    state = json.loads(path.read_text()) if resume and path.exists() else {"step": 0, "chain": "", "began": []}
    state["began"].append(state["step"])
    monitor.stage_started("optimization")
    while state["step"] < steps:
        if monitor.stop_requested():
            _save(path, state, monitor)
            raise Stopped
        pause()
        state["step"] += 1
        told(state["step"])
        state["chain"] = hashlib.sha256(f"{state['chain']} {state['step']}".encode()).hexdigest()
        if state["step"] % 10 == 0:
            _save(path, state, monitor)
        monitor.progress(state["step"], steps, {"l1": 1.0 / state["step"]})
    write_results(out, json.dumps(state))


def journaled(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Like `stepping`, but every step is told to the file $ADVTEX_ENGINE_JOURNAL with the time and the attempt (the
    workspace's name). By its seed a job dies in every attempt (seed % 20 == 7), or is rejected (13)."""
    journal = os.open(os.environ["ADVTEX_ENGINE_JOURNAL"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    if config.seed % 20 == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    if config.seed % 20 == 13:
        rejects(scan, out, config, work=work, resume=resume, monitor=monitor)

    def told(step: int) -> None:
        os.write(journal, f"{time.time()} {work.parent.name} {step}\n".encode())

    _steps(out, config.steps or 100, work / "state.json", resume, monitor, told)


def chain(steps: int) -> str:
    """What `stepping` must arrive at, however often it was interrupted."""
    link = ""
    for step in range(1, steps + 1):
        link = hashlib.sha256(f"{link} {step}".encode()).hexdigest()
    return link


def glimpsing(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Shows itself every 10 ms until it is asked to stop; the picture's bytes tell the step. Of an attempt that
    resumes nothing is seen."""
    monitor.stage_started("optimization")
    monitor.note("12 of 30 frames become views")
    mark = work / "mark.txt"
    mark.write_text("the first attempt was here")
    monitor.checkpointed((mark,))
    for step in range(1, 6000):
        curves = {"steps": [step], "series": {"l1": [0.5]}, "quality": {"steps": [], "series": {}}}
        if not resume:
            titles = {"0.jpg": "color/<1>.png"}
            monitor.glimpsed(Glimpse(step, {"0.jpg": b"picture %d" % step}, titles, curves))
            monitor.glimpsed(Glimpse(step, {"0.jpg": bytes(10**6)}, titles, curves))  # too large to be passed on
        monitor.progress(step, 6000, {"l1": 0.5})
        if monitor.stop_requested():
            raise Stopped
        time.sleep(0.01)


def crashes(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """SIGSEGV in the middle of a stage."""
    monitor.stage_started("ingest")
    print("about to read address 0", file=sys.stderr, flush=True)
    ctypes.string_at(0)


def is_killed(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """What the kernel does when memory runs out."""
    monitor.stage_started("ingest")
    os.kill(os.getpid(), signal.SIGKILL)


def crashes_once(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Dies in its first attempt, after a checkpoint."""
    mark = work / "mark.txt"
    if not resume:
        monitor.stage_started("atlas")
        monitor.warning(Problem("few_views", "color/", "only 3 views", "take more"))
        mark.write_text("first attempt")
        monitor.checkpointed((mark,))
        os.kill(os.getpid(), signal.SIGKILL)
    write_results(out, mark.read_text())


def exits(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Leaves without a word."""
    os._exit(7)


def raises(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    raise ValueError("the widget is not a gadget")


def finds_the_disk_full(
    scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor
) -> None:
    """Once; the next call finishes if it is to go on from the work folder."""
    if not resume:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    quick(scan, out, config, work=work, resume=resume, monitor=monitor)


def out_of_memory(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    raise MemoryError("cannot allocate 90 GiB")


def rejects(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    raise ScanError(
        Problem("no_view", "color/", "no frame sees the mesh", "check the poses"),
        Problem("bad_image", "color/1.png", "is no image", "export it again"),
    )


def refuses(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    raise OptionError("holdout 500 leaves no frame; choose less")


def hangs(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Stuck inside native code: never comes back to ask."""
    monitor.stage_started("atlas")
    time.sleep(600)


def hangs_alone(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """The same in native code that keeps the interpreter's lock: no other thread runs either."""
    monitor.stage_started("atlas")
    ctypes.PyDLL(None).sleep(600)


def ignores_stop(scan: Path, out: Path, config: TextureConfig, *, work: Path, resume: bool, monitor: Monitor) -> None:
    """Works on, whatever it is asked."""
    monitor.stage_started("optimization")
    for step in range(1, 30_000):
        monitor.stop_requested()
        monitor.progress(step, 30_000, {})
        time.sleep(0.02)


def write_results(out: Path, text: str) -> None:
    for name in RESULTS:
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{name}\n{text}\n")


def _save(path: Path, state: dict[str, object], monitor: Monitor) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(state))
    part.replace(path)
    monitor.checkpointed((path,))
