"""The bench: what it says of a step, of its parts and of the stages, on views so small that it takes a moment."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import advtex_engine
import advtex_options
from advtex_engine.__main__ import main
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import crop_size
from advtex_engine.bench import limits as bench_limits
from advtex_engine.bench import profile as bench_profile
from advtex_engine.bench import run as bench_module
from advtex_engine.bench import stages as bench_stages
from advtex_engine.bench.counts import ADAM_BYTES, PARAMETERS, Work, layer_sizes, step_flops, step_parts
from advtex_engine.bench.limits import Limits, least_seconds, measure_limits
from advtex_engine.bench.scene import made_scene
from advtex_engine.core.config import PRESETS
from advtex_engine.render.rasterize import rasterize

SMALL = ["bench", "--device", "cpu", "--width", "96", "--height", "72", "--views", "8", "--faces", "600"]
PARTS = {
    "draw and reproject",
    "render and forward",
    "texture backward",
    "discriminator backward and update",
    "texture update",
}
ON_DEVICE = {"upload", "view maps", "overlaps and pairs", "mean texture", "view selection", "dilation", "pictures"}
BY_LIBRARIES = {"decode", "atlas", "export"}
# What a bare GPU machine has: torch with what it requires itself, and numpy.
BARE = ("torch", "torchgen", "functorch", "numpy", "numpy.libs", "typing_extensions.py", "sympy", "mpmath", "networkx")
BARE_TOO = ("filelock", "fsspec", "jinja2", "markupsafe")
SHORT = """
import json

from advtex_engine.bench import limits, run, stages

run.WARMUP, run.STEPS, limits.FIRST_SIDE, stages.PICTURES = 1, 1, 64, 1
limits.LONG_ENOUGH = 0.0
limits.COPIED_BYTES["cpu"] = 1 << 20
print(json.dumps(run.bench("cpu", 96, 72, "paper", views=8, faces=600)))
"""


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few repetitions of little."""
    monkeypatch.setattr(bench_module, "WARMUP", 1)
    monkeypatch.setattr(bench_module, "STEPS", 3)
    monkeypatch.setattr(bench_stages, "PICTURES", 2)
    monkeypatch.setattr(bench_limits, "FIRST_SIDE", 64)
    monkeypatch.setattr(bench_limits, "LONG_ENOUGH", 0.0)
    monkeypatch.setitem(bench_limits.COPIED_BYTES, "cpu", 1 << 20)


@pytest.mark.usefixtures("short")
def test_a_step_its_parts_and_the_stages_are_timed_beside_their_floors(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SMALL, "--preset", "standard", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["preset"], result["width"], result["height"], result["views"]) == ("standard", 96, 72, 8)
    assert result["crop"] == list(crop_size(96, 72, PRESETS["standard"].max_crop))
    assert result["flops"] == step_flops(*result["crop"])
    assert 0 < result["step_ms_least"] <= result["step_ms"] < 10_000
    assert result["steps_per_second"] == pytest.approx(1000 / result["step_ms"], rel=0.01)
    assert result["gflops_per_second"] == pytest.approx(result["flops"] / result["step_ms"] / 1e6, rel=0.01, abs=0.1)
    limits = (result["product_gflops_per_second"], result["copy_gb_per_second"], result["upload_gb_per_second"])
    assert all(limit > 0 for limit in limits)
    parts, stages = result["parts"], result["stages"]
    assert parts.keys() == PARTS
    assert sum(part["share"] for part in parts.values()) == pytest.approx(1, abs=0.003)
    assert sum(part["floor_ms"] for part in parts.values()) == pytest.approx(result["floor_ms"], rel=0.01)
    assert stages.keys() == ON_DEVICE | BY_LIBRARIES
    for row in (*parts.values(), *(stages[name] for name in ON_DEVICE)):
        assert row["ms"] > 0
        assert row["ratio"] == pytest.approx(row["ms"] / row["floor_ms"], rel=0.02, abs=0.01)
    for name in PARTS:
        floor = parts[name]["gflop"] / limits[0] * 1e3 + parts[name]["mb"] / limits[1]
        assert parts[name]["floor_ms"] == pytest.approx(floor, rel=0.05)
    assert all(stages[name]["ms"] > 0 for name in BY_LIBRARIES)
    operations = result["profile"]["operations"]
    assert len(operations) == 12
    assert [row["ms"] for row in operations] == sorted((row["ms"] for row in operations), reverse=True)
    assert 0.5 < sum(row["share"] for row in operations) <= 1.001
    assert any("convolution_backward" in row["name"] and row["calls"] >= 5 for row in operations)
    assert 0 < result["profile"]["busy_ms"] < 10_000


def test_of_a_gpu_only_kernels_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def row(kind: str, name: str, device_us: float, cpu_us: float, count: int) -> SimpleNamespace:
        return SimpleNamespace(
            device_type=SimpleNamespace(name=kind),
            key=name,
            self_device_time_total=device_us,
            self_cpu_time_total=cpu_us,
            count=count,
        )

    rows = [row("CUDA", "wgrad" * 30, 3000.0, 0.0, 20), row("CUDA", "adam", 1000.0, 0.0, 40)]
    rows.append(row("CPU", "cudaGraphLaunch", 0.0, 9000.0, 1))
    recorded = nullcontext(SimpleNamespace(key_averages=lambda: rows))
    monkeypatch.setattr(bench_profile, "profile", lambda **_: recorded)
    monkeypatch.setattr(bench_profile, "wait_for", lambda _: None)
    stepper = SimpleNamespace(optimizer=SimpleNamespace(device=torch.device("cuda")), take=lambda _: 20)
    found = bench_profile.profile_steps(stepper, 5)  # type: ignore[arg-type]
    assert found["busy_ms"] == 0.2  # of 20 steps
    assert [(len(one["name"]), one["calls"], one["ms"], one["share"]) for one in found["operations"]] == [
        (100, 1, 0.15, 0.75),
        (4, 2, 0.05, 0.25),
    ]


def test_torch_and_numpy_are_enough(tmp_path: Path) -> None:
    """Nothing but our own packages, torch and numpy can be imported, as where nothing else is installed."""
    installed = Path(torch.__file__).parents[1]
    for name in (*BARE, *BARE_TOO):
        if (installed / name).exists():
            (tmp_path / name).symlink_to(installed / name)
    ours = (str(Path(module.__file__ or "").parents[1]) for module in (advtex_engine, advtex_options))
    path = os.pathsep.join((*ours, str(tmp_path)))
    done = subprocess.run(
        [sys.executable, "-S", "-c", SHORT],
        env={**os.environ, "PYTHONPATH": path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    stages = json.loads(line)["stages"]
    for name in ON_DEVICE:
        assert stages[name]["ms"] > 0
    for name, module in (("decode", "cv2"), ("atlas", "xatlas"), ("export", "cv2")):
        assert stages[name].keys() == {"skipped"}
        assert f"needs {module}, which cannot be imported here" in stages[name]["skipped"]


@pytest.mark.usefixtures("short")
def test_people_read_the_crop_the_full_frame_and_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(SMALL) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    wide, high = crop_size(96, 72)
    assert first == f"preset paper, crops of {wide}x{high} from full frames of 96x72"
    for name in ("step_ms", "steps_per_second", "ratio", *PARTS, *ON_DEVICE, *BY_LIBRARIES):
        assert any(line.startswith(f"{name} ") for line in rest), name


def test_the_counts_are_those_of_the_network() -> None:
    network = PatchDiscriminator(torch.Generator().manual_seed(0))
    assert sum(parameter.numel() for parameter in network.parameters()) == PARAMETERS
    logits = network(torch.zeros(1, 3, 120, 160), torch.zeros(1, 3, 120, 160))
    assert logits.numel() == layer_sizes(160, 120)[-1]


def test_the_parts_of_a_step_need_all_of_its_operations() -> None:
    parts = step_parts(576, 432, 1_000_000, 2)
    assert parts.keys() == PARTS
    convolutions = step_flops(576, 432)
    total = sum(part.flops for part in parts.values())
    assert convolutions < total < 1.02 * convolutions  # what is done per pixel and texel is little beside them
    assert parts["texture update"].bytes == 3 * 1_000_000 * ADAM_BYTES
    wider = step_parts(576, 432, 1_000_000, 4)
    assert all(wider[name].bytes >= parts[name].bytes for name in PARTS)
    assert wider["render and forward"].bytes > 1.5 * parts["render and forward"].bytes


def test_a_floor_adds_operations_bytes_and_upload() -> None:
    limits = Limits(flops=1e12, bytes=1e9, upload=1e8)
    work = Work(2e12, 3e9, 4e8)
    assert limits.floor(work.flops, work.bytes, work.uploaded) == pytest.approx(2 + 3 + 4)


@pytest.mark.usefixtures("short")
def test_limits_are_measured_and_no_product_beats_them_by_far(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_limits, "FIRST_SIDE", 512)
    cpu = torch.device("cpu")
    limits = measure_limits(cpu, torch.float32)
    assert limits.upload == pytest.approx(limits.bytes / 2, rel=0.9)
    a = torch.rand(512, 512)
    seconds = least_seconds(lambda: a @ a, cpu)
    assert 0.1 < 2 * 512**3 / seconds / limits.flops < 10


def test_the_scene_is_the_same_every_time_and_seen_from_all_around() -> None:
    scene, atlas = made_scene(600, 24, 96, 72)
    again, _ = made_scene(600, 24, 96, 72)
    assert all(torch.equal(a.color, b.color) for a, b in zip(scene.views, again.views, strict=True))
    mesh = scene.mesh
    assert len(mesh.t_pos_idx) == 12 * 7**2
    edges = torch.cat([mesh.t_pos_idx[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    turned = {(int(a), int(b)) for a, b in edges}
    assert len(turned) == len(edges)  # every edge once in each direction: closed, and wound one way
    assert {(b, a) for a, b in turned} == turned
    a, b, c = (mesh.v_pos[mesh.t_pos_idx[:, k]] for k in range(3))
    outward = (torch.linalg.cross(b - a, c - a) * a).sum(1)
    assert bool((outward > 0).all())
    seen = torch.zeros(len(mesh.t_pos_idx), dtype=torch.bool)
    for view in scene.views:
        faces = rasterize(mesh, view.camera).face_index
        assert 0.2 < float((faces >= 0).float().mean()) < 0.8
        seen[faces[faces >= 0].long()] = True
    assert float(seen.float().mean()) > 0.7
    assert mesh.v_uv is not None
    assert float(mesh.v_uv.min()) >= 0 and float(mesh.v_uv.max()) <= 1
    assert atlas.width == 320
