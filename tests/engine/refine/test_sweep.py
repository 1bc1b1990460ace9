"""Plane sweep along the normals: against a plain twin, and on a hilly sheet whose mesh is far off."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from wavy_sheet import HEIGHT, WIDTH, camera_over, paint, sheet

from advtex_engine.core.cameras import project
from advtex_engine.core.scene import Camera, Mesh
from advtex_engine.mesh.normals import vertex_normals
from advtex_engine.refine import sweep
from advtex_engine.render.rasterize import rasterize

VIEWS = 10
CAMERAS = [camera_over(i, VIEWS) for i in range(VIEWS)]
PIXEL = 1.6 / float(CAMERAS[0].K[0, 0])
OFFSETS = PIXEL * torch.tensor([-1.5, 0.0, 1.0, 2.5])


@pytest.fixture(scope="module")
def true_mesh() -> Mesh:
    return sheet(2.0, 40, (0.1, 4, 3, 0))


@pytest.fixture(scope="module")
def gray(true_mesh: Mesh) -> Tensor:
    """What the cameras see of it, [V,h,w]."""
    return torch.stack([photograph(true_mesh, camera) for camera in CAMERAS])


def photograph(mesh: Mesh, camera: Camera) -> Tensor:
    fragments = rasterize(mesh, camera)
    corners = mesh.v_pos[mesh.t_pos_idx[fragments.face_index.clamp(min=0).long()]]
    color = paint((corners * fragments.barycentric[..., None]).sum(2)).mean(2)
    return torch.where(fragments.face_index >= 0, color, 0.0)


def seen_depths(mesh: Mesh) -> Tensor:
    return torch.stack([rasterize(mesh, camera).depth for camera in CAMERAS])


def edges_of(mesh: Mesh) -> Tensor:
    pairs = {tuple(sorted((int(face[i]), int(face[i - 1])))) for face in mesh.t_pos_idx for i in range(3)}
    return torch.tensor(sorted(pairs))


def moved(mesh: Mesh, offset: Tensor | float) -> Mesh:
    offset = torch.as_tensor(offset).expand(len(mesh.v_pos))
    return replace(mesh, v_pos=mesh.v_pos + offset[:, None] * vertex_normals(mesh))


def correlation(a: Tensor, b: Tensor) -> float:
    """Of two patches [Q]; flat ones show nothing."""
    a, b = (part - part.mean() for part in (a, b))
    floor = len(a) * sweep.NOISE**2
    return float((a * b).sum() / ((a.square().sum() + floor) * (b.square().sum() + floor)).sqrt())


def looked_up(image: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear, pixel by pixel, at [Q,2]."""
    values = []
    for x, y in (pixels - 0.5).tolist():
        column, row = int(x // 1), int(y // 1)
        right, down = x - column, y - row
        upper, lower = (image[row + k, column] * (1 - right) + image[row + k, column + 1] * right for k in (0, 1))
        values.append(upper * (1 - down) + lower * down)
    return torch.stack(values)


def test_agreement_is_the_mean_correlation_of_all_pairs_of_views(true_mesh: Mesh, gray: Tensor) -> None:
    """Weighted by how much they face the surface; patches are those of the tangent plane with their perspective."""
    depths = seen_depths(true_mesh)
    agreed = sweep.agreement(true_mesh, CAMERAS, depths, gray, OFFSETS, PIXEL)
    normal = vertex_normals(true_mesh)
    side = PIXEL * torch.arange(-sweep.RADIUS, sweep.RADIUS + 1)
    compared = 0
    for vertex in range(7, len(true_mesh.v_pos), 97):
        position, out = true_mesh.v_pos[vertex], normal[vertex]
        across, along, _ = sweep._axes(out[None])[0]
        assert torch.allclose(torch.stack((across @ out, along @ out, across @ along)), torch.zeros(3), atol=1e-6)
        views = []
        for number, camera in enumerate(CAMERAS):
            (pixel,), (z,) = project(camera, position[None])
            x, y = pixel.tolist()
            if not (sweep.BORDER < x < WIDTH - sweep.BORDER and sweep.BORDER < y < HEIGHT - sweep.BORDER):
                continue
            center = torch.linalg.inv(camera.world_to_camera)[:3, 3].float()
            cosine = float(torch.nn.functional.normalize(center - position, dim=0) @ out)
            shown = float(depths[number, int(y), int(x)])
            if cosine > sweep.MIN_COSINE and shown > 0 and z < 1.01 * shown:
                views.append((number, cosine))
        for layer, offset in enumerate(OFFSETS):
            middle = position + offset * out
            points = torch.stack([middle + a * across + b * along for a in side for b in side])
            patches = [(looked_up(gray[k], project(CAMERAS[k], points)[0]), share) for k, share in views]
            pairs = [(a, b) for i, a in enumerate(patches) for b in patches[:i]]
            if not pairs:
                assert agreed[vertex, layer] == 0
                continue
            expected = sum(p * q * correlation(a, b) for (a, p), (b, q) in pairs) / sum(
                p * q for (_, p), (_, q) in pairs
            )
            assert float(agreed[vertex, layer]) == pytest.approx(expected, abs=0.02)
            compared += 1
    assert compared > 40


def test_photographs_agree_best_on_the_surface(true_mesh: Mesh, gray: Tensor) -> None:
    off = moved(true_mesh, -2 * PIXEL)
    offsets = PIXEL * torch.arange(-4.0, 5.0)
    agreed = sweep.agreement(off, CAMERAS, seen_depths(off), gray, offsets, PIXEL)
    inner = true_mesh.v_pos[:, :2].abs().amax(1) < 0.5
    assert (agreed[inner].argmax(1) == 6).float().mean() > 0.7
    assert agreed.abs().max() <= 1 + 1e-5


def test_only_the_views_that_a_vertex_faces_most_are_looked_at(
    true_mesh: Mesh, gray: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views 0 to 3 four times over are looked at as those of them that face it most."""
    depths = seen_depths(true_mesh)
    monkeypatch.setattr(sweep, "MOST_VIEWS", 3)
    few = sweep.agreement(true_mesh, CAMERAS[:4], depths[:4], gray[:4], OFFSETS, PIXEL)
    monkeypatch.setattr(sweep, "MOST_VIEWS", 100)
    every = [
        sweep.agreement(true_mesh, [CAMERAS[k] for k in kept], depths[kept], gray[kept], OFFSETS, PIXEL)
        for kept in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])
    ]
    same = torch.stack([(few - other).abs().amax(1) < 1e-5 for other in every])
    assert bool(same.any(0).all())
    assert bool((~same.all(0)).any())


def test_vertices_in_portions_are_as_all_at_once(
    true_mesh: Mesh, gray: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    depths = seen_depths(true_mesh)
    once = sweep.agreement(true_mesh, CAMERAS, depths, gray, OFFSETS, PIXEL)
    monkeypatch.setattr(sweep, "AT_ONCE", 700)
    assert torch.allclose(sweep.agreement(true_mesh, CAMERAS, depths, gray, OFFSETS, PIXEL), once, atol=1e-5)


def test_a_surface_that_is_off_by_several_pixels_is_found(gray: Tensor) -> None:
    """In and out by up to 3 pixels, from which a descent would not find back."""
    truth = sheet(2.0, 80, (0.1, 4, 3, 0))
    x, y, _ = truth.v_pos.unbind(1)
    off = moved(truth, 3 * PIXEL * torch.sin(2 * x + 1) * torch.cos(2 * y))
    found = moved(off, sweep.sweep_offsets(off, edges_of(off), CAMERAS, seen_depths(off), gray, 1.6))
    inner = truth.v_pos[:, :2].abs().amax(1) < 0.5
    before, after = (
        float(((mesh.v_pos - truth.v_pos) * vertex_normals(truth)).sum(1)[inner].square().mean().sqrt())
        for mesh in (off, found)
    )
    assert before > 1.8 * PIXEL
    assert after < 0.15 * before


def test_what_nothing_tells_of_takes_its_neighbors_offsets() -> None:
    """A row of vertices, of which those at both ends know where they are."""
    offsets = 0.1 * torch.arange(-8.0, 9.0)
    agreed = torch.zeros(21, 17)
    agreed[0] = agreed[-1] = torch.exp(-((offsets - 0.4) / 0.2).square())
    edges = torch.stack((torch.arange(20), torch.arange(1, 21)), 1)
    found = sweep.smooth_offsets(agreed, offsets, edges, 0.2)
    assert torch.allclose(found[[0, -1]], torch.tensor(0.4), atol=0.02)
    assert torch.allclose(found, torch.full((21,), 0.4), atol=0.05)
    alone = sweep.smooth_offsets(torch.zeros(21, 17), offsets, edges, 0.2)
    assert torch.equal(alone, torch.zeros(21))


def test_of_equal_peaks_neighbors_take_the_same() -> None:
    """A pattern that repeats agrees at two offsets; one vertex knows which."""
    offsets = 0.1 * torch.arange(-8.0, 9.0)
    peak = torch.exp(-((offsets - 0.4) / 0.1).square())
    agreed = (peak + 1.01 * peak.flip(0)).repeat(9, 1)
    agreed[2:7] = 1.5 * peak
    edges = torch.stack((torch.arange(8), torch.arange(1, 9)), 1)
    assert agreed[0].argmax() != agreed[4].argmax()
    found = sweep.smooth_offsets(agreed, offsets, edges, 0.2)
    assert torch.allclose(found, torch.full((9,), 0.4), atol=0.05)


def test_the_lowest_is_found_between_the_offsets() -> None:
    offsets = 0.5 * torch.arange(-4.0, 5.0)
    for place in (-1.3, 0.0, 0.6):
        assert float(sweep._lowest((offsets - place).square()[None], offsets)) == pytest.approx(place, abs=1e-5)
    assert float(sweep._lowest(offsets[None], offsets)) == -2.0
    assert float(sweep._lowest(torch.zeros(1, 9), offsets)) == -2.0
