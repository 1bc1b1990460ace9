"""The rasterizer against Embree's rays, a plain twin of all pixels times all triangles, and geometry done by hand."""

from __future__ import annotations

import os
from pathlib import Path

import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from torch import Tensor

from advtex_engine.core.cameras import camera_center, pixel_centers, project, unproject
from advtex_engine.core.scene import Camera, Fragments, Mesh
from advtex_engine.render.rasterize import NEAR, rasterize, rasterize_views

ROOT = Path(__file__).parents[3]
DATA = Path(os.environ.get("ADVTEX_DATA", ROOT.parent / "shared" / "data"))
KITCHEN = DATA / "scans" / "apt0_kitchen"


def looking(eye: tuple[float, ...], target: tuple[float, ...], width: int = 320, height: int = 240) -> Camera:
    """A camera of 65 degrees at `eye`, looking at `target`, world z up."""
    center = torch.tensor(eye, dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor(target, dtype=torch.float64) - center, dim=0)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return with_rotation(rotation, -rotation @ center, width, height)


def with_rotation(rotation: Tensor, translation: Tensor, width: int, height: int) -> Camera:
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, translation
    focal = 0.78 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, world_to_camera, width, height)


def plain_camera(width: int = 16, height: int = 12) -> Camera:
    """At the world's origin with the world's axes."""
    return with_rotation(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), width, height)


def mesh_of(vertices: ArrayLike, faces: ArrayLike) -> Mesh:
    return Mesh(torch.tensor(np.asarray(vertices, np.float32)), torch.tensor(np.asarray(faces, np.int64)))


def soup(count: int, seed: int) -> Mesh:
    corners = torch.randn((count, 3, 3), generator=torch.Generator().manual_seed(seed))
    return Mesh(corners.reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3))


def grid(columns: int, rows: int, height: float = 0.0) -> Mesh:
    """columns x rows squares of side 1 around the z axis, 2 faces each, with bumps of `height`."""
    y, x = torch.meshgrid(torch.arange(rows + 1.0), torch.arange(columns + 1.0), indexing="ij")
    z = height * torch.sin(x * 0.37) * torch.cos(y * 0.23)
    v_pos = torch.stack([x - columns / 2, y - rows / 2, z], dim=-1).reshape(-1, 3)
    first = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).reshape(-1, 1)
    upper, lower = torch.tensor([[0, 1, columns + 2]]), torch.tensor([[0, columns + 2, columns + 1]])
    return Mesh(v_pos, torch.stack([first + upper, first + lower], dim=1).reshape(-1, 3))


def equal(a: Fragments, b: Fragments) -> bool:
    pairs = ((a.face_index, b.face_index), (a.barycentric, b.barycentric), (a.depth, b.depth))
    return all(torch.equal(x, y) for x, y in pairs)


# Embree


def embree(mesh: Mesh, camera: Camera) -> tuple[Tensor, Tensor]:
    """Face index [H,W], -1 = none, and depth [H,W]: rays with a z of 1 in camera axes have their length in depth."""
    center, pixels = camera_center(camera), pixel_centers(camera).reshape(-1, 2)
    directions = (unproject(camera, pixels, torch.ones(len(pixels))) - center).float().numpy()
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.v_pos[mesh.t_pos_idx].numpy())
    origins = np.ascontiguousarray(np.broadcast_to(center.float().numpy(), directions.shape))
    hits = scene.run(origins, directions, query="INTERSECT", output=1)
    shape = (camera.height, camera.width)
    return torch.from_numpy(hits["primID"]).view(shape), torch.from_numpy(hits["tfar"]).view(shape)


def silhouette(depth: Tensor) -> Tensor:
    """Pixels with a jump of depth, or an end of the surface, among their 3x3 neighbors."""
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")
    farthest = torch.nn.functional.max_pool2d(padded, 3, stride=1)[0, 0]
    nearest = -torch.nn.functional.max_pool2d(-padded, 3, stride=1)[0, 0]
    return farthest > 1.01 * nearest


def assert_agrees_with_embree(mesh: Mesh, camera: Camera) -> None:
    fragments = rasterize(mesh, camera)
    face_index, depth = embree(mesh, camera)
    hit = face_index >= 0
    same = (hit == (fragments.face_index >= 0)) & (~hit | ((fragments.depth - depth).abs() <= 1e-4 * depth))
    assert same.double().mean() >= 0.999
    assert not (~same & ~silhouette(torch.where(hit, depth, 0.0))).any()
    # Rays that pass an edge by a rounding's breadth may name the neighbor.
    assert (fragments.face_index == face_index)[same].double().mean() >= 0.999


@pytest.mark.parametrize("eye", [(0.3, 0.2, 0.1), (-1.9, 2.4, -1.4), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("target", [(2.0, 1.0, -0.5), (-2.0, -2.5, 1.5), (0.5, 0.0, -2.0)])
def test_box_from_inside(eye: tuple[float, ...], target: tuple[float, ...]) -> None:
    box = trimesh.creation.box((4, 5, 3))
    mesh, camera = mesh_of(box.vertices, box.faces), looking(eye, target)
    assert (rasterize(mesh, camera).face_index >= 0).all()
    assert_agrees_with_embree(mesh, camera)


@pytest.mark.parametrize("eye", [(3.0, 0.2, 0.1), (0.2, 0.1, 0.0), (1.02, 0.0, 0.0)])
def test_sphere_from_outside_inside_and_close_by(eye: tuple[float, ...]) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5)
    assert_agrees_with_embree(mesh_of(sphere.vertices, sphere.faces), looking(eye, (0.0, 0.0, 0.02)))


@pytest.mark.parametrize("seed", range(3))
def test_triangle_soup(seed: int) -> None:
    assert_agrees_with_embree(soup(300, seed), looking((4.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


@pytest.mark.parametrize("seed", range(3))
def test_triangle_soup_around_the_camera(seed: int) -> None:
    mesh = soup(300, seed)
    a, b, c = mesh.v_pos[mesh.t_pos_idx].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    away = (a * normal).sum(1).abs() > 0.2  # single precision rays lose their digits on surfaces that they start from
    assert_agrees_with_embree(Mesh(mesh.v_pos, mesh.t_pos_idx[away]), looking((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))


def test_a_million_faces() -> None:
    """Waves one behind the other, most faces smaller than a pixel."""
    waves = grid(707, 707, height=3.0)
    assert len(waves.t_pos_idx) == 999_698
    assert_agrees_with_embree(waves, looking((20.0, -300.0, 60.0), (0.0, 0.0, 0.0)))


@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-3])
def test_planes_that_fight(gap: float) -> None:
    front, back = grid(7, 5), grid(7, 5)
    v_pos = torch.cat([back.v_pos - torch.tensor([0, 0, gap]), front.v_pos])
    mesh = Mesh(v_pos, torch.cat([back.t_pos_idx, front.t_pos_idx + len(back.v_pos)]))
    camera = looking((1.0, -3.0, 4.0), (0.0, 0.2, 0.0))
    fragments, (_, depth) = rasterize(mesh, camera), embree(mesh, camera)
    hit = fragments.face_index >= 0
    assert torch.equal(hit, depth < 1e6)
    assert torch.allclose(fragments.depth[hit], depth[hit], rtol=1e-4, atol=0)
    if gap == 0:
        assert (fragments.face_index < len(back.t_pos_idx)).all()
    if gap == 1e-3:
        assert (fragments.face_index[hit] >= len(back.t_pos_idx)).double().mean() > 0.999


@pytest.mark.data
@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the sample scan apt0_kitchen is not there")
@pytest.mark.parametrize("frame", [30, 60, 90])
def test_real_mesh(frame: int, kitchen: Mesh) -> None:
    first, second = (KITCHEN / f"color_{frame}.cam").read_text().splitlines()[:2]
    numbers = torch.tensor([float(x) for x in first.split()], dtype=torch.float64)
    focal = float(second.split()[0])
    camera = with_rotation(numbers[3:].view(3, 3), numbers[:3], 640, 480)
    K = torch.tensor([[focal, 0, 320], [0, focal, 240], [0, 0, 1]], dtype=torch.float64)
    assert_agrees_with_embree(kitchen, Camera(K, camera.world_to_camera, 640, 480))


@pytest.fixture(scope="module")
def kitchen() -> Mesh:
    mesh = trimesh.load_mesh(KITCHEN / "mesh.ply", process=False)
    return mesh_of(*fast_simplification.simplify(np.float32(mesh.vertices), mesh.faces, target_count=80_000))


# The plain twin


def plain_twin(mesh: Mesh, camera: Camera, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Every ray against every triangle (Moeller & Trumbore 1997): margin [P,T], depth [P,T], barycentrics [P,T,3].

    The margin is that by which the nearest bound of a hit is kept: positive inside, negative outside.
    """
    seen = (mesh.v_pos.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3])[mesh.t_pos_idx]
    pixels = pixel_centers(camera).reshape(-1, 2)
    rays = torch.cat([pixels, torch.ones(len(pixels), 1)], dim=1) @ torch.linalg.inv(camera.K).T
    a, ab, ac = seen[:, 0], seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]
    p = torch.linalg.cross(rays[:, None], ac[None])
    det = (p * ab).sum(-1)
    second = -(p * a).sum(-1) / det
    q = torch.linalg.cross(-a, ab)
    third = (rays[:, None] * q).sum(-1) / det
    depth = (ac * q).sum(-1) / det
    barycentric = torch.stack([1 - second - third, second, third], dim=-1)
    return torch.minimum(barycentric.amin(-1), depth - near), depth, barycentric


coordinate = st.floats(-3, 3, width=32)
triangle = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=3, max_size=3)


@settings(max_examples=150, deadline=None)
@given(st.lists(triangle, min_size=1, max_size=6), st.sampled_from([NEAR, 0.5]))
def test_same_as_the_plain_twin(triangles: list[list[tuple[float, ...]]], near: float) -> None:
    mesh, camera = mesh_of(np.reshape(triangles, (-1, 3)), np.arange(3 * len(triangles)).reshape(-1, 3)), plain_camera()
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    assume(bool(((a * normal).sum(1).abs() > 1e-4).all()))  # edge-on faces have no clear answer

    margin, depth, barycentric = plain_twin(mesh, camera, near)
    clear = (margin.abs() > 1e-6).all(1)
    depth = torch.where(margin > 0, depth, torch.inf)
    expected_depth, expected_face = depth.min(1)
    hit = clear & (expected_depth < torch.inf)
    alone = (depth < expected_depth[:, None] * (1 + 1e-5)).sum(1) == 1

    fragments = rasterize(mesh, camera, near=near)
    found_face, found_depth = fragments.face_index.flatten(), fragments.depth.flatten()
    assert torch.equal((found_face >= 0)[clear], (expected_depth < torch.inf)[clear])
    assert torch.allclose(found_depth[hit].double(), expected_depth[hit], rtol=1e-5, atol=0)
    assert torch.equal(found_face[hit & alone].long(), expected_face[hit & alone])
    expected = barycentric[torch.arange(len(margin)), expected_face][hit & alone]
    assert torch.allclose(fragments.barycentric.view(-1, 3)[hit & alone].double(), expected, atol=1e-6)


# Geometry by hand


def test_barycentrics_give_back_pixel_and_depth() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    mesh, camera = mesh_of(sphere.vertices, sphere.faces), looking((2.0, 1.0, 0.5), (0.0, 0.0, 0.0))
    fragments = rasterize(mesh, camera)
    hit = fragments.face_index >= 0
    corners = mesh.v_pos.double()[mesh.t_pos_idx[fragments.face_index[hit].long()]]
    pixels, depth = project(camera, (corners * fragments.barycentric[hit][..., None]).sum(1))
    assert torch.allclose(pixels, pixel_centers(camera)[hit], atol=1e-3)
    assert torch.allclose(depth, fragments.depth[hit].double(), rtol=1e-6)
    assert torch.allclose(fragments.barycentric[hit].sum(-1), torch.ones(int(hit.sum())), atol=1e-6)
    assert (fragments.barycentric >= 0).all()


def test_pixels_without_a_face_hold_the_pad_values() -> None:
    fragments = rasterize(mesh_of([[-1, -1, 5], [0, -1, 5], [-1, 0, 5]], [[0, 1, 2]]), plain_camera())
    none = fragments.face_index == -1
    assert 0 < none.sum() < none.numel()
    assert not fragments.depth[none].any()
    assert not fragments.barycentric[none].any()
    assert fragments.face_index.dtype == torch.int32
    assert fragments.depth.dtype == fragments.barycentric.dtype == torch.float32


def test_a_speck_is_seen_by_the_pixel_whose_center_it_holds() -> None:
    camera = plain_camera()
    speck = unproject(camera, torch.tensor([[5.49, 7.49], [5.52, 7.49], [5.49, 7.52]]), torch.full((3,), 2.0))
    beside = unproject(camera, torch.tensor([[5.51, 7.51], [5.54, 7.51], [5.51, 7.54]]), torch.full((3,), 2.0))
    assert (rasterize(mesh_of(speck, [[0, 1, 2]]), camera).face_index >= 0).nonzero().tolist() == [[7, 5]]
    assert (rasterize(mesh_of(beside, [[0, 1, 2]]), camera).face_index >= 0).sum() == 0


def test_floor_that_reaches_behind_the_camera() -> None:
    floor = mesh_of([[-1e4, 1.5, -1e4], [1e4, 1.5, -1e4], [0, 1.5, 1e4]], [[0, 1, 2]])
    camera = plain_camera(64, 48)
    fragments = rasterize(floor, camera)
    row = torch.arange(48, dtype=torch.float64) + 0.5
    expected = (1.5 * camera.K[1, 1] / (row - 24)).float()
    assert (fragments.face_index[:24] == -1).all()
    assert torch.allclose(fragments.depth[24:], expected[24:, None].expand(-1, 64), rtol=1e-6)


def test_what_is_nearer_than_the_near_plane_is_seen_through() -> None:
    corners = np.array([[-9, -9, 0.2], [9, -9, 0.2], [0, 9, 2.2], [-90, -90, 5], [90, -90, 5], [0, 90, 5]])
    fragments = rasterize(mesh_of(corners, [[0, 1, 2], [3, 4, 5]]), plain_camera(), near=1.2)
    assert torch.equal(fragments.face_index == 0, (fragments.depth < 5))
    assert 0 < (fragments.face_index == 0).sum() < fragments.face_index.numel()
    assert (fragments.depth >= 1.2).all()


@pytest.mark.parametrize(("focal", "z"), [(1.0, 1.0), (0.1, 0.1), (0.1, 1.0), (0.7, 3.0), (1 / 3, 7.0)])
def test_edges_and_corners_on_pixel_centers_leave_no_hole_and_go_to_the_lowest_face(focal: float, z: float) -> None:
    squares = grid(8, 6)
    K = torch.tensor([[focal, 0, 4.5], [0, focal, 3.5], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), 9, 7)
    v_pos = (squares.v_pos.double() * (z / focal)).float() + torch.tensor([0.0, 0.0, z])  # one pixel per square
    fragments = rasterize(Mesh(v_pos, squares.t_pos_idx), camera)
    within = (slice(1, -1), slice(1, -1))  # the rim itself may be rounded outwards or inwards in float32
    assert (fragments.face_index[within] >= 0).all()
    assert (fragments.barycentric >= 0).all()
    assert torch.allclose(fragments.depth[within], torch.tensor(z), rtol=1e-7)
    if (v_pos[:, :2].double() * focal / v_pos[:, 2:] - squares.v_pos[:, :2]).abs().max() < 1e-12:
        at_corner = [(squares.t_pos_idx == vertex).any(1).nonzero()[0].item() for vertex in range(len(v_pos))]
        assert fragments.face_index.flatten().tolist() == at_corner


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1, 2, 3]))
def test_closed_surfaces_have_no_holes_from_inside(seed: int, subdivisions: int) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    generator = torch.Generator().manual_seed(seed)
    rotation, _ = torch.linalg.qr(torch.randn((3, 3), generator=generator, dtype=torch.float64))
    camera = with_rotation(rotation * rotation.det(), torch.zeros(3, dtype=torch.float64), 64, 48)
    assert (rasterize(mesh_of(sphere.vertices, sphere.faces), camera).face_index >= 0).all()


@pytest.mark.parametrize("aside", [0.0, 1e-16, 1e-12, 1e-11, 5e-11, 1e-10, 1e-9, 1e-6])
@pytest.mark.parametrize("shift", [0.0, 5e-10, -5e-10, 9e-10, -9e-10])
@pytest.mark.parametrize("turned", [False, True])
def test_a_face_seen_edge_on_hides_nothing_and_has_its_own_depth(aside: float, shift: float, turned: bool) -> None:
    corners = np.array([[0, -1, 1], [0, 1, 1], [0, 0, 3], [-90, -90, 5], [90, -90, 5], [0, 90, 5]])
    K = torch.tensor([[20.0, 0, 8.5 + shift], [0, 20, 8.5 + shift], [0, 0, 1]], dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:2, 3] = aside
    mesh = mesh_of(corners[:, [1, 0, 2]] if turned else corners, [[0, 1, 2], [3, 4, 5]])
    fragments = rasterize(mesh, Camera(K, world_to_camera, 17, 17))
    if turned:
        fragments = Fragments(fragments.face_index.T, fragments.barycentric.transpose(0, 1), fragments.depth.T)
    on_wall = fragments.face_index == 1
    assert on_wall[:, torch.arange(17) != 8].all()
    assert torch.allclose(fragments.depth[on_wall], torch.tensor(5.0))
    assert ((fragments.depth[~on_wall] > 0.99) & (fragments.depth[~on_wall] < 3.01)).all()
    assert (fragments.face_index >= 0).all()


def test_both_sides_are_visible() -> None:
    mesh, camera = soup(100, 7), looking((4.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    turned = Mesh(mesh.v_pos, mesh.t_pos_idx.flip(1))
    one, other = rasterize(mesh, camera), rasterize(turned, camera)
    assert torch.equal(one.face_index, other.face_index)
    assert torch.allclose(one.barycentric, other.barycentric.flip(-1), atol=1e-6)


@pytest.mark.parametrize(
    "vertices",
    [
        [[0, 0, 2], [1, 1, 2], [2, 2, 2]],
        [[0, 0, 2], [0, 0, 2], [0, 0, 2]],
        [[-9, -9, -2], [9, -9, -2], [0, 9, -2]],
        [[-9, -9, 2], [9, -9, 2], [0, float("nan"), 2]],
        [[-9, -9, 2], [9, -9, 2], [0, float("inf"), 2]],
        [[-9, -9, 0], [9, -9, 0], [0, 9, 0]],
    ],
    ids=["line", "point", "behind", "nan", "inf", "through the camera's center"],
)
def test_faces_that_cannot_be_seen(vertices: list[list[float]]) -> None:
    fragments = rasterize(mesh_of(vertices, [[0, 1, 2]]), plain_camera())
    assert (fragments.face_index == -1).all()
    assert not fragments.depth.any()


def test_mesh_without_faces() -> None:
    empty = Mesh(torch.zeros(0, 3), torch.zeros((0, 3), dtype=torch.int64))
    assert (rasterize(empty, plain_camera()).face_index == -1).all()


# One result, however it is computed


def test_views_at_once_and_one_by_one_are_the_same() -> None:
    mesh = soup(400, 3)
    cameras = [looking((4.0, y, 0.3), (0.0, 0.0, 0.0)) for y in (-1.0, 0.0, 2.0)] + [plain_camera(50, 70)]
    together = list(rasterize_views(mesh, cameras))
    assert len(together) == 4
    assert all(equal(rasterize(mesh, camera), found) for camera, found in zip(cameras, together, strict=True))


def test_blocks_and_threads_do_not_change_a_bit() -> None:
    mesh, camera = soup(1000, 5), looking((0.5, 0.3, 0.0), (0.0, 0.0, 0.0), 90, 70)
    whole = rasterize(mesh, camera)
    assert equal(whole, rasterize(mesh, camera))
    for max_bytes in (1 << 17, 1 << 20):
        assert equal(whole, rasterize(mesh, camera, max_bytes=max_bytes))
    few = soup(5, 1)
    assert equal(rasterize(few, plain_camera()), rasterize(few, plain_camera(), max_bytes=1))
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if threads > 1 else 2)
    try:
        assert equal(whole, rasterize(mesh, camera))
    finally:
        torch.set_num_threads(threads)
