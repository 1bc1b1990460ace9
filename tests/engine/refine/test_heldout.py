"""Held-out poses against a finished texture: known errors are found, nothing else is followed, the report says so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from torch import Tensor

from advtex_engine.__main__ import main
from advtex_engine.core.cameras import project
from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.refine.heldout import refine_heldout
from advtex_engine.refine.pose import exponential, twist
from advtex_engine.render.render_view import render_view
from advtex_engine.results.export import export_model

WIDTH, HEIGHT, FOCAL, FRAMES = 160, 120, 150.0, 3
SIDE = 16  # squares


def relief() -> Atlas:
    """A sheet of 2.4 x 2.4 m with hills of 20 cm, 1.5 m before the cameras, its texture laid on from the front."""
    side = torch.linspace(-1.2, 1.2, SIDE + 1)
    y, x = torch.meshgrid(side, side, indexing="ij")
    position = torch.stack((x, y, 1.5 + 0.1 * torch.sin(4 * x) * torch.cos(3 * y)), -1).reshape(-1, 3)
    first = (torch.arange(SIDE)[:, None] * (SIDE + 1) + torch.arange(SIDE)).flatten()
    faces = torch.cat(
        (
            torch.stack((first, first + 1, first + SIDE + 2), 1),
            torch.stack((first, first + SIDE + 2, first + SIDE + 1), 1),
        )
    )
    return Atlas(Mesh(position, faces, (position[:, :2] + 1.2) / 2.4, faces), 256, 256, "scan", 1)


def blobs() -> Tensor:
    """[256,256,3]: smoothed noise of several sizes."""
    generator = torch.Generator().manual_seed(2)
    layers = [
        torch.nn.functional.interpolate(torch.rand(1, 3, n, n, generator=generator), (256, 256), mode="bicubic")
        for n in (16, 32, 64)
    ]
    return torch.stack(layers).mean(0)[0].permute(1, 2, 0).clamp(0, 1)


def camera(index: int) -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.2 * index - 0.2, 0.05 * index, 0.0])
    return Camera(K, pose, WIDTH, HEIGHT)


def misplaced() -> list[Tensor]:
    """World-to-camera poses that are off by some pixels, turned and moved."""
    twists = torch.randn(FRAMES, 6, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    motions = exponential(twists * torch.tensor([1, 1, 1, 1.5, 1.5, 1.5]) * 2.5 / FOCAL)
    return [motion @ camera(index).world_to_camera for index, motion in enumerate(motions)]


def photograph(index: int) -> Tensor:
    """[H,W,3] uint8: from the true camera, darker and bluer than the model."""
    color = render_view(relief(), blobs(), camera(index)) * torch.tensor([0.8, 0.85, 0.95]) + 0.02
    return (color.clamp(0, 1) * 255).round().to(torch.uint8)


def errors(poses: list[Tensor]) -> Tensor:
    """[V]: median pixels that the relief's vertices in the middle are off."""
    points = relief().mesh.v_pos
    points = points[(points[:, :2].abs() < 0.6).all(1)]
    off = []
    for index, pose in enumerate(poses):
        there, _ = project(camera(index), points)
        shown, _ = project(replace(camera(index), world_to_camera=pose), points)
        off.append((there - shown).norm(dim=1).median())
    return torch.stack(off)


def test_known_errors_are_found() -> None:
    given = misplaced()
    views = [
        View(str(index), replace(camera(index), world_to_camera=pose), photograph(index))
        for index, pose in enumerate(given)
    ]
    refined, report = refine_heldout(relief(), blobs(), views, "scene")
    before, after = errors(given), errors([view.camera.world_to_camera for view in refined])
    assert before.min() > 1
    assert after.max() < 0.25
    for row, view, new in zip(report, views, refined, strict=True):
        assert row["name"] == view.name
        assert not row["kept_pose"]
        assert new.color is view.color
        assert torch.equal(new.camera.K, view.camera.K)
    moved = torch.tensor([row["moved_pixels"] for row in report])
    assert (moved / before - 1).abs().max() < 0.4


def test_a_pixel_under_noise_is_found_by_who_takes_the_better_guess() -> None:
    views = []
    for index, pose in enumerate(misplaced()):
        motion = pose @ torch.linalg.inv(camera(index).world_to_camera)
        small = exponential(0.4 * twist(motion[None]))[0] @ camera(index).world_to_camera
        noise = 25 * torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(index))
        color = (photograph(index) + noise).clamp(0, 255).round().to(torch.uint8)
        views.append(View(str(index), replace(camera(index), world_to_camera=small), color))
    _, sure = refine_heldout(relief(), blobs(), views, "scene")
    refined, guessed = refine_heldout(relief(), blobs(), views, "scene", standard_errors=0.0)
    assert any(row["kept_pose"] for row in sure)
    assert not any(row["kept_pose"] for row in guessed)
    assert errors([view.camera.world_to_camera for view in refined]).max() < 0.25


def test_a_photograph_of_something_else_keeps_its_pose() -> None:
    noise = torch.randint(60, 190, (15, 20, 3), generator=torch.Generator().manual_seed(3), dtype=torch.uint8)
    view = View("noise", camera(0), noise.repeat_interleave(8, 0).repeat_interleave(8, 1))
    behind = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    blind = replace(view, name="blind", camera=replace(view.camera, world_to_camera=behind))
    refined, report = refine_heldout(relief(), blobs(), [view, blind], "scene")
    assert refined[0] is view
    assert refined[1] is blind
    assert [row["kept_pose"] for row in report] == [True, True]
    assert [row["moved_pixels"] for row in report] == [0, 0]


def write_scan(folder: Path) -> Path:
    """A native scan with the misplaced poses."""
    folder.mkdir()
    frames = []
    for index, pose in enumerate(misplaced()):
        cv2.imwrite(str(folder / f"{index}.png"), photograph(index).numpy()[..., ::-1])
        frames.append({"color": f"{index}.png", "camera_to_world": torch.linalg.inv(pose).tolist()})
    size = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
    scan = {"version": 1, "kind": "scene", "up_axis": "+z", "mesh": "mesh.obj", "color_intrinsics": size}
    (folder / "scan.json").write_text(json.dumps({**scan, "frames": frames}))
    mesh = relief().mesh
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.v_pos.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.t_pos_idx.tolist()]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    return folder


def test_evaluate_refines_only_when_asked_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export_model(tmp_path / "model", relief(), blobs(), up_axis="+z")
    command = ["evaluate", str(tmp_path / "model/model.obj"), str(write_scan(tmp_path / "scan"))]
    written = []
    for name, options in (("plain", []), ("refined", ["--refine-heldout"])):
        path = tmp_path / f"{name}.json"
        assert main([*command, *options, "--json", str(path)]) == 0
        written.append(json.loads(path.read_text()))
        printed = capsys.readouterr().out
        assert ("poses were refined against the model" in printed) == bool(options)
    plain, refined = written
    assert plain["refined"] is None
    assert [row["name"] for row in refined["refined"]] == [row["view"] for row in refined["per_view"]]
    assert all(row["moved_pixels"] > 1 for row in refined["refined"])
    assert refined["mean"]["ssim"] > plain["mean"]["ssim"] + 0.1
