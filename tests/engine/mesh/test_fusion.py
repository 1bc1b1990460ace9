"""Fusion of depth images: every step beside a plain twin, and known surfaces from what cameras measure of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import advtex_engine.mesh.fusion as fusion
from advtex_engine.core.cameras import pixel_centers
from advtex_engine.core.errors import Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Camera, DepthFrame, Mesh
from advtex_engine.mesh.fusion import choose_voxel_size, fuse, remove_floaters
from advtex_engine.mesh.tsdf import (
    BLOCK,
    FREE_WEIGHT,
    MIN_COSINE,
    NEAR,
    TRUNCATION_SHARE,
    TRUNCATION_VOXELS,
    Sampling,
    block_corners,
    encode_blocks,
    find_blocks,
    integrate,
)

CPU = torch.device("cpu")
WIDTH, HEIGHT, FOCAL = 80, 60, 70.0
RADIUS = 0.2
Surface = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


@pytest.fixture(scope="module", autouse=True)
def coarse_voxels() -> Iterator[None]:
    """Images here have few pixels: voxels of their size keep the tests short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fusion, "VOXEL_SHARE", 1 / 60)
        patch.setattr(fusion, "COARSEST", 0.03)
        yield


def camera_at(eye: Sequence[float], target: Sequence[float] = (0, 0, 0)) -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor(target).double() - torch.tensor(eye).double(), dim=0)
    helper = torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())]
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, helper), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ torch.tensor(eye).double()
    return Camera(K, world_to_camera, WIDTH, HEIGHT)


def measure(camera: Camera, surface: Surface) -> DepthFrame:
    """What a perfect sensor measures. surface: origin [3] and directions [...,3] -> ray lengths, inf = nothing hit."""
    rays = torch.cat((pixel_centers(camera), torch.ones(HEIGHT, WIDTH, 1)), 2) @ torch.linalg.inv(camera.K).T
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    length = surface(-rotation.T @ translation, rays @ rotation)
    return DepthFrame(camera, torch.where(length.isfinite(), length, 0.0).float())


def sphere(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
    a, b = (rays * rays).sum(-1), (rays * origin).sum(-1)
    root = b.square() - a * (origin @ origin - RADIUS**2)
    return torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, math.inf)


def plane(height: float, farthest: float = 4.0) -> Surface:
    def hit(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        length = (height - origin[2]) / rays[..., 2]
        return torch.where((length > 0) & (length < farthest), length, math.inf)

    return hit


def around(count: int, distance: float) -> list[Camera]:
    """Cameras on a spiral over the whole sphere of directions."""
    heights = (np.arange(count) + 0.5) / count * 2 - 1
    angles = np.arange(count) * np.pi * (3 - 5**0.5)
    flat = np.sqrt(1 - heights**2)
    eyes = distance * np.stack((flat * np.cos(angles), flat * np.sin(angles), heights), 1)
    return [camera_at(eye) for eye in eyes.tolist()]


# Known surfaces -------------------------------------------------------------------------------------------------------


def test_a_sphere_seen_from_all_sides_is_closed_and_in_place() -> None:
    frames = [measure(camera, sphere) for camera in around(24, 0.7)]
    mesh, report = fuse(frames, CPU, Monitor())
    voxel = report["voxel_size_mm"] / 1000
    off = (mesh.v_pos.double().norm(dim=1) - RADIUS).abs()
    assert float(off.median()) < 0.1 * voxel
    assert float(off.max()) < 1.5 * voxel
    edges = mesh.t_pos_idx.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    directed = {tuple(edge) for edge in edges.tolist()}
    assert {(b, a) for a, b in directed} == directed
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    assert float((torch.linalg.cross(a, b) * c).sum()) / 6 == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.02)
    assert report["faces"] == len(mesh.t_pos_idx)
    assert report["frames"] == 24


def test_poses_that_are_off_by_pixels_do_not_eat_the_edges_of_what_stands_before_a_wall() -> None:
    def plate_and_wall(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        near, far = plane(0.3)(origin, rays), plane(-0.3)(origin, rays)
        place = origin + rays * near[..., None]
        return torch.where(place[..., :2].norm(dim=-1) < RADIUS, near, far)

    generator = torch.Generator().manual_seed(0)
    frames = []
    for _ in range(16):
        frame = measure(camera_at([0.02, 0.01, 1.3]), plate_and_wall)
        pose = frame.camera.world_to_camera.clone()
        pose[:2, 3] += 0.04 * (2 * torch.rand(2, generator=generator) - 1)  # up to 3 pixels at the plate
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    mesh, _ = fuse(frames, CPU, Monitor())
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    plate = ((a[:, 2] - 0.3).abs() < 0.03) & (a[:, :2].norm(dim=1) < 1.5 * RADIUS)
    area = 0.5 * float(torch.linalg.cross(b - a, c - a)[plate, 2].abs().sum())
    assert area == pytest.approx(math.pi * RADIUS**2, rel=0.04)


@settings(max_examples=10, deadline=None)
@given(
    height=st.floats(-0.3, 0.3),
    tilt=st.floats(0, 55),
    turn=st.floats(0, 360),
    distance=st.floats(0.5, 2.0),
)
def test_a_plane_lies_where_one_camera_sees_it(height: float, tilt: float, turn: float, distance: float) -> None:
    """Also when tilted: inverse depth is linear in the image, and so interpolated without error."""
    polar, azimuth = math.radians(tilt), math.radians(turn)
    eye = [
        distance * math.sin(polar) * math.cos(azimuth),
        distance * math.sin(polar) * math.sin(azimuth),
        height + distance * math.cos(polar),
    ]
    frame = measure(camera_at(eye, (0, 0, height)), plane(height, 1.5 * distance))
    mesh, report = fuse([frame], CPU, Monitor())
    voxel = report["voxel_size_mm"] / 1000
    off = (mesh.v_pos[:, 2] - height).abs()
    assert float(off.quantile(0.95)) < 0.01 * voxel
    assert float(off.max()) < voxel  # at the border, where a neighbor is missing, the nearest pixel stands for all
    a, b, c = mesh.v_pos[mesh.t_pos_idx].unbind(1)
    assert bool((torch.linalg.cross(b - a, c - a)[:, 2] >= -1e-9).all())


def test_noise_averages_out_over_frames() -> None:
    generator = torch.Generator().manual_seed(0)
    clean = [measure(camera, sphere) for camera in around(60, 0.7)]
    noisy = [
        DepthFrame(
            frame.camera, (frame.depth + 0.004 * torch.randn(frame.depth.shape, generator=generator)).clamp(min=0)
        )
        for frame in clean
    ]
    kept = [DepthFrame(n.camera, torch.where(c.depth > 0, n.depth, 0.0)) for n, c in zip(noisy, clean, strict=True)]
    mesh, _ = fuse(kept, CPU, Monitor())
    assert float((mesh.v_pos.norm(dim=1) - RADIUS).abs().median()) < 0.001


def test_nothing_is_made_up_between_a_near_and_a_far_surface() -> None:
    """Half of the image shows a wall at 1 m, the other half one at 2 m."""
    camera = camera_at((0, 0, 0), (0, 0, -1))
    near, far = measure(camera, plane(-1.0)), measure(camera, plane(-2.0))
    depth = near.depth.clone()
    depth[:, WIDTH // 2 :] = far.depth[:, WIDTH // 2 :]
    mesh, report = fuse([DepthFrame(camera, depth)], CPU, Monitor())
    off = torch.minimum((mesh.v_pos[:, 2] + 1).abs(), (mesh.v_pos[:, 2] + 2).abs())
    assert float(off.max()) < 1e-5
    at_near = mesh.v_pos[mesh.v_pos[:, 2] > -1.5]
    pixel = 1 / FOCAL
    across = at_near @ camera.world_to_camera[0, :3].float()
    assert float(across.max()) < 0.5 * pixel + report["voxel_size_mm"] / 1000


def test_what_the_device_does_not_trust_is_not_used() -> None:
    frame = measure(camera_at((0, 0, 1)), plane(0.0))
    confidence = torch.ones(HEIGHT, WIDTH)
    confidence[:, : WIDTH // 2] = 0
    mesh, _ = fuse([DepthFrame(frame.camera, frame.depth, confidence)], CPU, Monitor())
    whole, _ = fuse([frame], CPU, Monitor())
    assert len(mesh.t_pos_idx) == pytest.approx(len(whole.t_pos_idx) / 2, rel=0.05)


def test_trusted_readings_win_over_doubtful_ones() -> None:
    """Two sensors disagree by 10 mm; the mean is weighted 9 : 1."""
    camera = camera_at((0, 0, 2))
    low, high = measure(camera, plane(0.0)), measure(camera, plane(0.01))
    doubtful = DepthFrame(camera, high.depth, torch.full((HEIGHT, WIDTH), 1 / 9))
    mesh, _ = fuse([low, doubtful], CPU, Monitor())
    assert float(mesh.v_pos[:, 2].median()) == pytest.approx(0.001, abs=2e-4)


# Refusals and bounds --------------------------------------------------------------------------------------------------


def lonely_readings() -> torch.Tensor:
    depth = torch.zeros(HEIGHT, WIDTH)
    depth[::10, ::10] = 1.0
    return depth


@pytest.mark.parametrize("depth", [torch.zeros(HEIGHT, WIDTH), lonely_readings()])
def test_readings_without_a_surface_are_refused_with_a_remedy(depth: torch.Tensor) -> None:
    with pytest.raises(ScanError) as caught:
        fuse([DepthFrame(camera_at((0, 0, 1)), depth)], CPU, Monitor())
    (problem,) = caught.value.problems
    assert problem.code == "no_surface"
    assert "scale" in problem.remedy


def test_no_frames_are_refused() -> None:
    with pytest.raises(ScanError, match="no depth image has a reading"):
        fuse([], CPU, Monitor())


def test_voxels_grow_until_they_fit_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [measure(camera, sphere) for camera in around(12, 0.7)]
    _, fine = fuse(frames, CPU, Monitor())
    bound = fine["blocks"] * BLOCK**3 * fusion.VOXEL_BYTES // 3
    monkeypatch.setattr(fusion, "MAX_VOXEL_BYTES", bound)
    listener = Listener()
    mesh, coarse = fuse(frames, CPU, listener)
    assert coarse["blocks"] * BLOCK**3 * fusion.VOXEL_BYTES <= bound
    assert coarse["voxel_size_mm"] > fine["voxel_size_mm"]
    assert [problem.code for problem in listener.warnings] == ["voxels_coarsened"]
    assert float((mesh.v_pos.norm(dim=1) - RADIUS).abs().median()) < 0.2 * coarse["voxel_size_mm"] / 1000


def test_voxels_are_finer_for_what_was_scanned_from_near() -> None:
    assert choose_voxel_size(0.6) == pytest.approx(0.6 * fusion.VOXEL_SHARE)
    assert choose_voxel_size(4.0) == fusion.COARSEST
    assert choose_voxel_size(0.01) == fusion.FINEST


def test_small_pieces_are_removed_and_large_ones_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fusion, "FLOATER_SHARE", 0.2)
    strip = torch.tensor([[k, k + 1, k + 2] for k in range(6)])
    faces = torch.cat((strip, strip[:1] + 8, strip[:4] + 12))
    position = torch.arange(3 * 20, dtype=torch.float32).view(20, 3)
    mesh, removed = remove_floaters(Mesh(position, faces))
    assert removed == 1
    assert len(mesh.t_pos_idx) == 10
    assert torch.equal(mesh.v_pos[mesh.t_pos_idx], position[torch.cat((faces[:6], faces[7:]))])
    assert len(mesh.v_pos) == 14


# Plain twins ----------------------------------------------------------------------------------------------------------


def stepped_frame(rng: np.random.Generator) -> DepthFrame:
    """Tilted patches with jumps between them and holes, seen from anywhere."""
    eye = rng.normal(size=3)
    camera = camera_at((eye / np.linalg.norm(eye) * rng.uniform(0.8, 1.6)).tolist(), rng.uniform(-0.1, 0.1, 3).tolist())
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    patch = (u // 20 + 2 * (v // 30)) % 4
    depth = rng.uniform(0.8, 1.4, 4)[patch] + rng.uniform(-0.002, 0.002, 4)[patch] * u
    depth[rng.random(depth.shape) < 0.02] = 0
    confidence = torch.from_numpy(rng.random(depth.shape)).float()
    return DepthFrame(camera, torch.from_numpy(depth).float(), confidence)


Maps = tuple[np.ndarray, np.ndarray, np.ndarray]


def plain_weights(frame: DepthFrame, sampling: Sampling) -> Maps:
    """Depth without what is no surface, weights, and metres from pixel to pixel, pixel by pixel."""
    depth = frame.depth.numpy().astype(float)
    (fx, _, cx), (_, fy, cy) = frame.camera.K[:2].tolist()
    stride = sampling.stride(frame.camera)
    weight, steps = np.zeros_like(depth), np.zeros_like(depth)

    def slope(row: int, column: int, down: int, across: int) -> float:
        best = 1e4
        for sign in (-1, 1):
            r, c = row + sign * down * stride, column + sign * across * stride
            if 0 <= r < HEIGHT and 0 <= c < WIDTH and depth[r, c] > 0:
                change = sign * (depth[r, c] - depth[row, column]) / stride
                best = change if abs(change) < abs(best) else best
        return best

    for row, column in zip(*np.nonzero(depth), strict=True):
        z, u, v = depth[row, column], column + 0.5 - cx, row + 0.5 - cy
        across, down = slope(row, column, 0, 1), slope(row, column, 1, 0)
        steps[row, column] = abs(across) + abs(down)
        normal = np.array([fx * across, fy * down, -(z + u * across + v * down)])
        ray = np.array([u / fx, v / fy, 1])
        cosine = abs(normal @ ray) / np.linalg.norm(normal) / np.linalg.norm(ray)
        if cosine > MIN_COSINE:
            assert frame.confidence is not None
            weight[row, column] = cosine**2 * (sampling.reference / z) ** 2 * float(frame.confidence[row, column])
    return np.where(weight > 0, depth, 0), weight, steps


def plain_reading(frame: DepthFrame, maps: Maps, point: np.ndarray, sampling: Sampling) -> tuple[float, float]:
    """What a frame says about one point: signed distance and weight."""
    depth, weight, steps = maps
    x, y, z = (frame.camera.world_to_camera.numpy() @ [*point, 1])[:3]
    if z <= NEAR:
        return 0, 0
    u, v = frame.camera.K.numpy()[:2] @ [x / z, y / z, 1] - 0.5
    if not (0 <= u <= WIDTH - 1 and 0 <= v <= HEIGHT - 1):
        return 0, 0
    column, row = min(int(u), WIDTH - 2), min(int(v), HEIGHT - 2)
    u, v = u - column, v - row
    four = depth[row : row + 2, column : column + 2]
    least = max(TRUNCATION_VOXELS * sampling.voxel_size, TRUNCATION_SHARE * four.max())
    if four.max() - four.min() > least + steps[row, column] or four.min() == 0:
        u, v = round(u), round(v)
    shares = np.outer([1 - v, v], [1 - u, u])
    inverse = (shares * np.where(four > 0, 1 / np.maximum(four, 1e-9), 0)).sum()
    if inverse == 0:
        return 0, 0
    measured = 1 / inverse
    truncation = max(TRUNCATION_VOXELS * sampling.voxel_size, TRUNCATION_SHARE * measured)
    share = np.clip((measured - z + truncation) / (truncation - sampling.voxel_size), 0, 1)
    if measured - z > truncation:
        share = FREE_WEIGHT
    return min(measured - z, truncation), float(weight[row + round(v), column + round(u)] * share)


@pytest.mark.parametrize("seed", range(4))
def test_integration_is_its_plain_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [stepped_frame(rng) for _ in range(2)]
    sampling = Sampling(0.02, 1.0)
    keys = find_blocks(frames, sampling, CPU)
    blocks = integrate(frames, keys, sampling, 1e-3, Monitor())
    maps = [plain_weights(frame, sampling) for frame in frames]
    offsets = torch.cartesian_prod(*[torch.arange(BLOCK)] * 3)
    compared = 0
    for block in rng.choice(len(keys), 3, replace=False):
        points = ((block_corners(keys)[block] + offsets) * sampling.voxel_size).numpy()
        for voxel in rng.choice(len(points), 60, replace=False):
            said = [plain_reading(f, m, points[voxel], sampling) for f, m in zip(frames, maps, strict=True)]
            total, weight = sum(d * w for d, w in said), sum(w for _, w in said)
            if weight < 2e-3:
                continue
            compared += 1
            assert float(blocks.distance[block, voxel]) == pytest.approx(total / weight, abs=2e-4)
    assert compared > 0


@pytest.mark.parametrize("seed", range(3))
def test_blocks_are_those_about_the_readings(seed: int) -> None:
    frame = stepped_frame(np.random.default_rng(seed))
    sampling = Sampling(0.02, 1.0)
    depth, _, _ = plain_weights(frame, sampling)
    to_world = torch.linalg.inv(frame.camera.world_to_camera).numpy()
    K = frame.camera.K.numpy()
    stride = sampling.stride(frame.camera)
    wanted = set()
    for row in range(stride // 2, HEIGHT, stride):
        for column in range(stride // 2, WIDTH, stride):
            z = depth[row, column]
            if z > 0:
                seen = np.linalg.inv(K) @ [column + 0.5, row + 0.5, 1] * z
                point = (to_world @ [*seen, 1])[:3] / sampling.voxel_size
                low, high = (np.floor((point + sign * TRUNCATION_VOXELS) / BLOCK).astype(int) for sign in (-1, 1))
                wanted |= {(x, y, z) for x in {low[0], high[0]} for y in {low[1], high[1]} for z in {low[2], high[2]}}
    keys = find_blocks([frame], sampling, CPU)
    assert torch.equal(keys, encode_blocks(torch.tensor(sorted(wanted))))
