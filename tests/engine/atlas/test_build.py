"""The atlas: injective, within its cap, dense enough for the views, and which texels it covers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from atlases import AROUND, area, bumpy_sphere, camera, check_sound, of_trimesh, texel_corners
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.atlas.build import SIZE_STEP, build_atlas, for_photographs, texel_coverage, why_not_kept
from advtex_engine.atlas.charting import PADDING, Charts, make_charts
from advtex_engine.atlas.density import pixel_density
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.errors import OptionError, Problem, ScanError
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh, View, face_areas
from advtex_engine.mesh.clean import clean


class Listener(Monitor):
    def __init__(self) -> None:
        self.warnings: list[Problem] = []

    def warning(self, problem: Problem) -> None:
        self.warnings.append(problem)


# New charts


def test_atlas_of_a_box_is_injective_and_covers_every_face() -> None:
    mesh = of_trimesh(trimesh.creation.box((1, 1, 1)))
    atlas = build_atlas(mesh, AROUND, TextureConfig(), Listener())
    check_sound(atlas, mesh)
    assert atlas.source == "xatlas"
    assert 1 <= atlas.charts <= 6


@pytest.mark.parametrize("texels_per_pixel", [1.0, 1.3])
def test_texels_follow_the_views(texels_per_pixel: float) -> None:
    """A square seen head-on from 4 m at f = 300 takes 75 pixels per metre."""
    square = Mesh(
        torch.tensor([(0.0, y, z) for y, z in ((-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5))]),
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )
    atlas = build_atlas(square, [camera((4, 0, 0))], TextureConfig(texels_per_pixel=texels_per_pixel), Listener())
    assert area(texel_corners(atlas)).sum() == pytest.approx((3 * 75 * texels_per_pixel) ** 2, rel=0.03)


def photograph(cell: int, mask: torch.Tensor | None = None) -> View:
    """Of noise that changes every `cell` pixels, and between in straight lines."""
    seen_from = camera((4, 0, 0), 96, 96)
    coarse = torch.rand((1, 3, 96 // cell, 96 // cell), generator=torch.Generator().manual_seed(4))
    picture = torch.nn.functional.interpolate(coarse, (96, 96), mode="bilinear")[0].permute(1, 2, 0)
    return View("frame", seen_from, (picture * 255).round().to(torch.uint8), mask=mask)


def test_blurred_photographs_get_as_many_texels_as_pixels() -> None:
    config = TextureConfig()
    assert for_photographs(config, [photograph(1)] * 3) == config
    assert for_photographs(config, [photograph(3)] * 3).texels_per_pixel == pytest.approx(1.0)


def test_what_was_not_scanned_does_not_blur_photographs() -> None:
    sharp, scanned = photograph(1), torch.arange(96).expand(96, -1) < 8
    color = torch.where(scanned[..., None], sharp.color, photograph(8).color)
    config = TextureConfig()
    assert for_photographs(config, [replace(sharp, color=color)]).texels_per_pixel < 1.1
    assert for_photographs(config, [replace(sharp, color=color, mask=scanned)]) == config
    assert for_photographs(config, [replace(sharp, color=color, depth=2.0 * scanned)]) == config


def test_what_no_view_sees_gets_few_texels() -> None:
    mesh = bumpy_sphere(3)
    atlas = build_atlas(mesh, [camera((4, 0, 0))], TextureConfig(), Listener())
    per_metre = area(texel_corners(atlas)) / face_areas(mesh).numpy()
    x = mesh.v_pos[mesh.t_pos_idx].mean(dim=1)[:, 0]
    assert np.median(per_metre[(x > 0.7).numpy()]) > 3 * np.median(per_metre[(x < -0.5).numpy()])


@pytest.mark.parametrize("cap", [256, 320, 500, 1024])
def test_the_cap_holds(cap: int) -> None:
    near = [camera((2.2, 0, 0), 1600, 1200, 1500.0), camera((-2.2, 0, 0), 1600, 1200, 1500.0)]
    mesh = bumpy_sphere(3)
    atlas = build_atlas(mesh, near, TextureConfig(max_texture_size=cap), Listener())
    check_sound(atlas, mesh)
    assert cap - 2 * SIZE_STEP < atlas.width <= cap


def test_charts_that_cannot_fit_the_cap_are_an_error() -> None:
    rng = np.random.default_rng(0)
    corner = rng.uniform(-1, 1, (4_000, 1, 3))
    soup = (corner + rng.normal(0, 0.01, (4_000, 3, 3))).reshape(-1, 3)
    mesh = Mesh(torch.from_numpy(soup).float(), torch.arange(12_000).view(-1, 3))
    with pytest.raises(OptionError, match="do not fit a texture of 256 texels; raise the maximal texture size"):
        build_atlas(mesh, AROUND, TextureConfig(max_texture_size=256), Listener())


def test_same_input_same_bytes() -> None:
    mesh = bumpy_sphere(4)  # two blocks, so that xatlas works in threads
    atlases = [build_atlas(mesh, AROUND, TextureConfig(), Listener()) for _ in range(2)]
    uv = [atlas.mesh.v_uv.numpy().tobytes() for atlas in atlases if atlas.mesh.v_uv is not None]
    faces = [atlas.mesh.t_uv_idx.numpy().tobytes() for atlas in atlases if atlas.mesh.t_uv_idx is not None]
    assert uv[0] == uv[1]
    assert faces[0] == faces[1]
    check_sound(atlases[0], mesh)


def test_non_manifold_meshes_get_an_atlas() -> None:
    sphere = bumpy_sphere(2)
    count = len(sphere.v_pos)
    fan = torch.tensor([[0, 1, count], [0, 1, count + 1], [0, 1, count + 2], [0, count, 40]])  # an edge of five faces
    loose = torch.tensor([[5, count + 1, count + 2]])  # joined in one vertex only
    extra = torch.tensor([(2.0, 0, 0), (0, 2, 0), (0, 0, 2)])
    flipped = sphere.t_pos_idx.clone()
    flipped[::3] = flipped[::3].flip(1)
    mesh = clean(Mesh(torch.cat([sphere.v_pos, extra]), torch.cat([flipped, fan, loose])))
    check_sound(build_atlas(mesh, AROUND, TextureConfig(), Listener()), mesh)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale: float) -> None:
    """The same views of a mesh in other units give as many charts and texels."""
    mesh = bumpy_sphere(2)
    scaled = Mesh(mesh.v_pos * scale, mesh.t_pos_idx)
    far = [camera((4 * scale, 0, 0)), camera((0, 4 * scale, 0)), camera((-4 * scale, 0, 0))]
    near = [camera((4, 0, 0)), camera((0, 4, 0)), camera((-4, 0, 0))]
    here, there = (build_atlas(m, views, TextureConfig(), Listener()) for m, views in ((mesh, near), (scaled, far)))
    check_sound(there, scaled)
    assert there.charts == pytest.approx(here.charts, rel=0.2)
    assert area(texel_corners(there)).sum() == pytest.approx(area(texel_corners(here)).sum(), rel=0.05)


def test_slivers_get_an_atlas() -> None:
    """Faces whose height is 1e-3 to 1e-6 of their length, loose beside a sound surface."""
    rng = np.random.default_rng(0)
    start, along, across = rng.normal(0, 1, (3, 100, 3))
    across *= 10 ** rng.uniform(-6, -3, (100, 1))
    corners = np.stack([start, start + 0.3 * along, start + 0.15 * along + across], axis=1).reshape(-1, 3)
    sphere = bumpy_sphere(2)
    faces = torch.arange(300).view(-1, 3) + len(sphere.v_pos)
    mesh = clean(
        Mesh(torch.cat([sphere.v_pos, torch.from_numpy(corners).float()]), torch.cat([sphere.t_pos_idx, faces]))
    )
    check_sound(build_atlas(mesh, AROUND, TextureConfig(), Listener()), mesh)


def test_charts_that_xatlas_collapsed_stay_inside_the_texture(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it does with needles of a tenth of a millimetre in a mesh of a room."""

    def collapsing(*arguments: Any) -> Charts:
        charts = make_charts(*arguments)
        uv = charts.uv.copy()
        uv[charts.faces[charts.chart == 3]] = (1206.5, 1177.5)
        return replace(charts, uv=uv)

    monkeypatch.setattr("advtex_engine.atlas.build.make_charts", collapsing)
    uv = build_atlas(bumpy_sphere(2), AROUND, TextureConfig(), Listener()).mesh.v_uv
    assert uv is not None
    assert 0 <= float(uv.min()) <= float(uv.max()) <= 1


def test_a_mesh_that_no_camera_sees_is_an_error() -> None:
    behind = [camera((4, 0, 0))]
    mesh = Mesh(torch.tensor([(9.0, 0, 0), (9, 1, 0), (9, 0, 1)]), torch.tensor([[0, 1, 2]]))
    with pytest.raises(ScanError, match="no frame sees the mesh"):
        build_atlas(mesh, behind, TextureConfig(), Listener())


def test_charts_keep_their_distance() -> None:
    """No texel is touched by two charts, and PADDING texels on either side are free."""
    atlas = build_atlas(bumpy_sphere(3), AROUND, TextureConfig(), Listener())
    assert atlas.mesh.t_uv_idx is not None
    faces = atlas.mesh.t_uv_idx.numpy()
    least = np.arange(faces.max() + 1)  # the least uv index that each one is connected with
    while (least[faces] != least[faces].min(axis=1, keepdims=True)).any():
        np.minimum.at(least, faces, least[faces].min(axis=1, keepdims=True))
    chart = least[faces[:, 0]]
    corners = texel_corners(atlas)
    touched = np.zeros((atlas.height, atlas.width), dtype=np.int64)
    for label in np.unique(chart):
        touched += texel_coverage(corners[chart == label], atlas.width, atlas.height, reach=PADDING - 0.5) > 0
    assert len(np.unique(chart)) == atlas.charts > 5
    assert touched.max() == 1


# The scan's own uv


def grid_with_uv(transform: np.ndarray, shift: tuple[float, float] = (0, 0)) -> Mesh:
    """A wavy sheet of 20 x 20 quads, uv = transform @ its plane coordinates in [0, 1] + shift."""
    x, y = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21))
    position = np.stack([0.1 * np.sin(6 * x), x - 0.5, y - 0.5], axis=2).reshape(-1, 3)
    uv = np.stack([x, y], axis=2).reshape(-1, 2) @ transform.T + shift
    first = np.arange(20 * 21).reshape(20, 21)[:, :-1].reshape(-1)
    faces = np.concatenate(
        [np.stack([first, first + 1, first + 21], 1), np.stack([first + 1, first + 22, first + 21], 1)]
    )
    return Mesh(
        torch.from_numpy(position).float(),
        torch.from_numpy(faces),
        torch.from_numpy(uv).float(),
        torch.from_numpy(faces),
    )


def test_injective_uv_are_kept() -> None:
    mesh = grid_with_uv(np.diag([0.9, 0.8]), (0.05, 0.1))
    listener = Listener()
    atlas = build_atlas(mesh, [camera((4, 0, 0))], TextureConfig(), listener)
    assert (atlas.source, atlas.charts) == ("scan", 1)
    assert atlas.mesh is mesh
    assert listener.warnings == []
    assert atlas.width % SIZE_STEP == 0


def test_kept_uv_are_as_dense_as_the_views_ask_and_obey_the_cap() -> None:
    mesh = grid_with_uv(np.eye(2))
    wanted = face_areas(mesh).double().sum().sqrt().item() * 300 / 4 * 1.2 * 4
    dense = build_atlas(mesh, [camera((4, 0, 0), 1280, 960, 1200.0)], TextureConfig(), Listener())
    assert wanted * 0.9 < dense.width < wanted * 1.1 + SIZE_STEP
    capped = build_atlas(mesh, [camera((4, 0, 0), 1280, 960, 1200.0)], TextureConfig(max_texture_size=300), Listener())
    assert capped.width == 256


@pytest.mark.parametrize(
    ("transform", "shift", "reason"),
    [
        pytest.param(np.diag([1.0, 1.0]), (0.3, 0), r"lie outside \[0, 1\]", id="outside"),
        pytest.param(np.array([[1.0, 0], [1.0, 0]]), (0, 0), "have no area", id="collapsed"),
        pytest.param(np.diag([0.1, 0.1]), (0, 0), "use only 1.0% of the texture", id="waste"),
        pytest.param(np.diag([np.nan, 1.0]), (0, 0), "outside", id="not a number"),
    ],
)
def test_uv_that_cannot_be_textured_are_replaced_with_the_reason(
    transform: np.ndarray, shift: tuple[float, float], reason: str
) -> None:
    listener = Listener()
    mesh = grid_with_uv(transform, shift)
    atlas = build_atlas(mesh, [camera((4, 0, 0))], TextureConfig(), listener)
    assert atlas.source == "xatlas"
    check_sound(atlas, Mesh(mesh.v_pos, mesh.t_pos_idx) if atlas.mesh.v_pos is not mesh.v_pos else mesh)
    assert [problem.code for problem in listener.warnings] == ["uv_replaced"]
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(listener.warnings[0].message)


@pytest.mark.parametrize(("overlap", "kept"), [(0.0, True), (0.01, True), (0.1, False), (0.5, False)])
def test_overlap_is_measured(overlap: float, kept: bool) -> None:
    """Two sheets side by side, the second one pushed over the first by a share of its width."""
    left, right = grid_with_uv(np.diag([0.4, 0.8])), grid_with_uv(np.diag([0.4, 0.8]), (0.4 * (1 - overlap), 0))
    assert left.v_uv is not None
    assert right.v_uv is not None
    both = torch.cat([left.t_pos_idx, right.t_pos_idx + len(left.v_pos)])
    mesh = Mesh(torch.cat([left.v_pos, right.v_pos + 1]), both, torch.cat([left.v_uv, right.v_uv]), both)
    reason = why_not_kept(mesh)
    assert (reason is None) == kept
    if reason is not None:
        share = overlap / (2 - overlap)
        assert float(reason.split("%")[0]) / 100 == pytest.approx(share, abs=0.01)


# Texture space


def brute_force_coverage(triangles: np.ndarray, width: int, height: int, reach: float) -> np.ndarray:
    """Each texel against each triangle, by Sutherland-Hodgman clipping of the triangle to the texel's square."""

    def clip(polygon: list[np.ndarray], axis: int, limit: float, sign: float) -> list[np.ndarray]:
        out: list[np.ndarray] = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            inside_p, inside_q = sign * (p[axis] - limit) <= 0, sign * (q[axis] - limit) <= 0
            if inside_p:
                out.append(p)
            if inside_p != inside_q:
                out.append(p + (q - p) * (limit - p[axis]) / (q[axis] - p[axis]))
        return out

    counts = np.zeros((height, width), dtype=np.int64)
    for triangle in triangles:
        for row in range(height):
            for column in range(width):
                polygon = list(triangle)
                for axis, center in ((0, column + 0.5), (1, row + 0.5)):
                    for sign in (1.0, -1.0):
                        polygon = clip(polygon, axis, center + sign * reach, sign) if polygon else []
                if len(polygon) >= 3:
                    ring = np.array(polygon)
                    following = np.roll(ring, -1, axis=0)
                    enclosed = abs((ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum())
                    counts[row, column] += enclosed > 0
    return counts


@given(
    st.lists(st.tuples(*[st.floats(-1, 7, width=32)] * 6), min_size=1, max_size=3), st.sampled_from([0.25, 1.0, 1.5])
)
@settings(max_examples=40, deadline=None)
def test_coverage_agrees_with_clipping(points: list[tuple[float, ...]], reach: float) -> None:
    triangles = np.array(points).reshape(-1, 3, 2)
    triangles = triangles[area(triangles) > 1e-3]
    counts = texel_coverage(triangles, 6, 5, reach)
    twin = brute_force_coverage(triangles, 6, 5, reach)
    # A corner that only grazes a square may be counted by either.
    wider, narrower = (brute_force_coverage(triangles, 6, 5, reach + slack) for slack in (1e-6, -1e-6))
    assert ((counts == twin) | ((counts >= narrower) & (counts <= wider))).all()


def test_coverage_of_centers_counts_each_once_across_shared_edges() -> None:
    mesh = grid_with_uv(np.eye(2))
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    counts = texel_coverage(mesh.v_uv[mesh.t_uv_idx].double().numpy() * 64, 64, 64, reach=0.0)
    assert (counts > 0).all()
    assert (counts == 1).mean() > 0.97


# Density


def test_density_of_a_plane_seen_head_on_and_at_an_angle() -> None:
    """fx fy / z^2 head-on; times the cosine where the plane is tilted about the optical axis' foot."""
    small = 0.01
    for angle in (0.0, 0.9):
        across = np.array([np.sin(angle), np.cos(angle), 0.0])
        corners = [small * across, -small * across + (0, 0, small), -small * across - (0, 0, small)]
        mesh = Mesh(torch.tensor(np.array(corners), dtype=torch.float32), torch.tensor([[0, 1, 2]]))
        density = pixel_density(mesh, [camera((4, 0, 0))])
        assert density.item() == pytest.approx(300 * 300 / 16 * np.cos(angle), rel=0.02)


def test_a_face_larger_than_the_image_counts_where_it_is_seen() -> None:
    """Its centroid and corners lie outside of the image, 16 m to the left of the axis."""
    mesh = Mesh(torch.tensor([(0.0, 16, -50), (0, 16, 50), (0, -80, 0)]), torch.tensor([[0, 1, 2]]))
    density = pixel_density(mesh, [camera((4, 0, 0))])
    assert density.item() == pytest.approx(300 * 300 / 16, rel=0.05)


def test_a_room_of_twelve_faces_is_seen_from_inside() -> None:
    room = of_trimesh(trimesh.creation.box((6, 5, 3)))
    atlas = build_atlas(
        room, [camera(eye) for eye in ((0.5, 0, 0.1), (-0.5, 0, 0.1), (0, 0.5, 0.1))], TextureConfig(), Listener()
    )
    check_sound(atlas, room)


def test_density_ignores_what_is_hidden_or_out_of_the_image() -> None:
    def sheet(x: float, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        y, z = np.meshgrid(np.linspace(-0.5, 0.5, 31) + shift, np.linspace(-0.5, 0.5, 31))
        first = np.arange(30 * 31).reshape(30, 31)[:, :-1].reshape(-1)
        return np.stack([np.full_like(y, x), y, z], 2).reshape(-1, 3), np.concatenate(
            [np.stack([first, first + 1, first + 31], 1), np.stack([first + 1, first + 32, first + 31], 1)]
        )

    parts = [sheet(0.5), sheet(-0.5), sheet(0.0, 9.0), sheet(9.0)]  # near, hidden behind it, beside, behind the camera
    positions = np.concatenate([part[0] for part in parts])
    faces = np.concatenate([part[1] + index * 31 * 31 for index, part in enumerate(parts)])
    density = pixel_density(Mesh(torch.from_numpy(positions).float(), torch.from_numpy(faces)), [camera((4, 0, 0))])
    seen = (density > 0).view(4, -1).float().mean(dim=1)
    assert seen[0] == 1
    assert seen[1] < 0.05
    assert seen[2] == 0
    assert seen[3] == 0


def test_many_cameras_are_sampled_evenly() -> None:
    mesh = bumpy_sphere(2)
    few, many = pixel_density(mesh, AROUND[:2]), pixel_density(mesh, AROUND[:1] * 500 + AROUND[1:2] * 500)
    assert few.sum() == pytest.approx(many.sum().item(), rel=2e-3)
