"""The closest points of a mesh: those that brute force finds, on the side that looks the same way."""

from __future__ import annotations

import torch

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.closest import ClosestPoints


def sheet(cells: int, height: float, *, down: bool = False) -> Mesh:
    """A wavy unit square of cells x cells cells that faces +z, or -z."""
    at = torch.linspace(0, 1, cells + 1)
    y, x = torch.meshgrid(at, at, indexing="ij")
    index = torch.arange((cells + 1) ** 2).view(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.cat([torch.stack(corners, -1).view(-1, 3) for corners in ((a, b, c), (a, c, d))])
    v_pos = torch.stack((x, y, height + 0.05 * torch.sin(7 * x + 4 * y)), -1).view(-1, 3)
    return Mesh(v_pos, faces.flip(1) if down else faces)


def both(one: Mesh, other: Mesh) -> Mesh:
    return Mesh(torch.cat((one.v_pos, other.v_pos)), torch.cat((one.t_pos_idx, other.t_pos_idx + len(one.v_pos))))


def brute_force(mesh: Mesh, points: torch.Tensor, cuts: int = 24) -> torch.Tensor:
    """[N] distances to the nearest of many points on each face."""
    i, j = torch.meshgrid(torch.arange(cuts + 1), torch.arange(cuts + 1), indexing="ij")
    weight = torch.stack((i, j), -1)[i + j <= cuts] / cuts
    weight = torch.cat((1 - weight.sum(1, keepdim=True), weight), 1)
    return torch.cdist(points, (weight @ mesh.v_pos[mesh.t_pos_idx]).view(-1, 3)).amin(1)


def test_points_are_as_near_as_brute_force_finds_and_lie_on_their_faces() -> None:
    mesh = sheet(6, 0.0)
    points = torch.rand((400, 3), generator=torch.Generator().manual_seed(2)) - torch.tensor([0, 0, 0.5])
    found = ClosestPoints(mesh).find(points, torch.tensor([[0.0, 0, 1]]).expand(400, 3))
    on_face = found.mix(mesh.v_pos, mesh.t_pos_idx)
    assert torch.allclose((points - on_face).norm(dim=1), found.distance, atol=1e-5)
    assert float(found.barycentric.min()) > -1e-6
    near = found.distance < 0.02  # as the surfaces that are compared; farther away another face may be nearer
    assert near.sum() > 10
    assert float((found.distance - brute_force(mesh, points))[near].max()) < 1e-3


def test_of_two_sides_of_a_board_the_one_is_found_that_looks_the_same_way() -> None:
    board = both(sheet(8, 0.002), sheet(8, 0.0, down=True))
    middle = board.v_pos[:81].clone() - torch.tensor([0, 0, 0.001])
    for normal, faces in ((1.0, range(128)), (-1.0, range(128, 256))):
        found = ClosestPoints(board).find(middle, torch.tensor([[0.0, 0, normal]]).expand(81, 3))
        assert set(found.face.tolist()) <= set(faces)


def test_points_far_from_the_mesh_are_answered_too_and_no_points_as_well() -> None:
    closest = ClosestPoints(sheet(8, 0.0))
    far = closest.find(torch.tensor([[0.5, 0.5, 40.0]]), torch.tensor([[0.0, 0, 1]]))
    assert 39.9 < float(far.distance) < 40.3
    assert len(closest.find(torch.zeros((0, 3)), torch.zeros((0, 3))).face) == 0
