"""What the rasterizer costs: peak memory against its bound, and time beside Embree; each in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]

MEMORY = """
import json, resource, sys, torch
from advtex_engine.render.rasterize import rasterize
from advtex_engine.core.scene import Camera, Mesh
K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
camera = Camera(K, torch.eye(4, dtype=torch.float64), 640, 480)
if sys.argv[1] == "fine":
    y, x = torch.meshgrid(torch.linspace(-2, 2, 708), torch.linspace(-2, 2, 708), indexing="ij")
    v_pos = torch.stack([x, y, 2 + 0.2 * torch.sin(9 * x)], dim=-1).reshape(-1, 3)
    first = (torch.arange(707)[:, None] * 708 + torch.arange(707)).reshape(-1, 1)
    faces = torch.cat([first + torch.tensor([[0, 1, 709]]), first + torch.tensor([[0, 709, 708]])])
else:
    depth = torch.linspace(9, 1, 60)[:, None]
    corners = torch.tensor([[-9.0, -9, 1], [9, -9, 1], [0, 9, 1]])
    v_pos, faces = (corners * depth[:, :, None]).reshape(-1, 3), torch.arange(180).reshape(-1, 3)
rasterize(Mesh(v_pos[:3], torch.tensor([[0, 1, 2]])), camera)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
fragments = rasterize(Mesh(v_pos, faces), camera, max_bytes=32 << 20)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
visible = len(fragments.face_index.unique())
fixed = 50 * (len(v_pos) + len(faces)) + 100 * visible + 30 * 640 * 480
print(json.dumps({"faces": len(faces), "hit": bool((fragments.face_index >= 0).all()),
                  "used": (after - before) * 1024, "allowed": fixed + (32 << 20)}))
"""


@pytest.mark.parametrize(("scene", "faces"), [("fine", 999_698), ("screen-filling", 60)])
def test_memory_stays_within_its_bound(scene: str, faces: int) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT / "worker")}
    command = [sys.executable, "-c", MEMORY, scene]
    report = json.loads(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
    assert report["faces"] == faces
    assert report["hit"]
    assert report["used"] <= report["allowed"]


@pytest.mark.benchmark
def test_no_slower_than_embree() -> None:
    script = ROOT / "tests" / "benchmarks" / "rasterize_vs_embree.py"
    environment = os.environ | {"PYTHONPATH": str(ROOT / "worker")}
    command = [sys.executable, str(script), "--json", "--repetitions", "4"]
    report = json.loads(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
    assert report["faces"] == pytest.approx(80_000, rel=0.01)
    assert report["same_face"] > 0.999
    assert report["ratio_to_face_only"] <= 1.0
