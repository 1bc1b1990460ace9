"""Seams: offsets against a dense solver, and what leveling and blending do to views of one scene."""

from __future__ import annotations

import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.render.texels import map_texels, surface_points
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.selection.leveling import (
    ANCHOR,
    SMOOTHNESS,
    Sampler,
    blend_texels,
    conjugate_gradients,
    full_band,
    low_band,
    make_nodes,
    seam_offsets,
)
from advtex_engine.selection.mrf import face_adjacency

WIDTH, HEIGHT, FOCAL = 96, 96, 96.0
CELLS, SIDE = 12, 96


def plane() -> Atlas:
    """The unit square at z = 0, split into CELLS x CELLS quads, its texture as it lies."""
    line = torch.linspace(0, 1, CELLS + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack((x, y, torch.zeros_like(x)), 2).view(-1, 3)
    corner = (torch.arange(CELLS)[:, None] * (CELLS + 1) + torch.arange(CELLS)).flatten()
    a, b, c, d = corner, corner + 1, corner + CELLS + 2, corner + CELLS + 1
    faces = torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))
    return Atlas(Mesh(position, faces, position[:, :2].clone(), faces), SIDE, SIDE, "scan", 1)


def maps_of(atlas: Atlas, images: list[Tensor]) -> ViewMaps:
    """Cameras 1 m in front of the square; pixel (column, row) shows x = column / WIDTH, y = row / HEIGHT."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.5, -0.5, 1.0])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    views = tuple(View(f"{i}", Camera(K, pose, WIDTH, HEIGHT), image) for i, image in enumerate(images))
    return build_view_maps(atlas, views, "object")


def halves(atlas: Atlas) -> Tensor:
    """View 0 left of x = 0.5, view 1 right of it."""
    return (atlas.mesh.v_pos[atlas.mesh.t_pos_idx].mean(1)[:, 0] > 0.5).long()


def noise(seed: int) -> Tensor:
    return torch.randint(60, 160, (HEIGHT, WIDTH, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def test_conjugate_gradients_agree_with_a_dense_solver() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn((20, 20), generator=generator)
    matrix = root @ root.T + torch.eye(20)
    b = torch.randn((20, 3), generator=generator)
    b[:, 2] = 0
    torch.testing.assert_close(
        conjugate_gradients(lambda x: matrix @ x, b), torch.linalg.solve(matrix, b), atol=2e-3, rtol=0
    )


def test_every_corner_has_the_node_of_its_vertex_and_its_faces_view() -> None:
    atlas = plane()
    label = halves(atlas)
    label[:5] = -1
    nodes = make_nodes(atlas.mesh.t_pos_idx, label, 2)
    assert bool((nodes.corner[:5] == -1).all())
    assert torch.equal(nodes.vertex[nodes.corner[5:]], atlas.mesh.t_pos_idx[5:])
    assert torch.equal(nodes.view[nodes.corner[5:]], label[5:, None].expand(-1, 3))
    assert len(torch.unique(torch.stack((nodes.vertex, nodes.view)), dim=1).T) == len(nodes.vertex)


def test_offsets_are_the_least_squares_solution() -> None:
    atlas = plane()
    faces, label = atlas.mesh.t_pos_idx, halves(atlas)
    nodes, adjacency = make_nodes(faces, label, 2), face_adjacency(faces)
    color = torch.where(nodes.view[:, None] == 0, 0.50, 0.51).expand(-1, 3).contiguous()  # too little to be an outlier
    offset = seam_offsets(faces, label, adjacency, nodes, color)
    dense = torch.eye(len(nodes.vertex), dtype=torch.float64) * ANCHOR
    push = torch.zeros(len(nodes.vertex), dtype=torch.float64)

    def spring(i: int, j: int, strength: float, gap: float = 0.0) -> None:
        for p, q in ((i, j), (j, i)):
            dense[p, p] += strength
            dense[p, q] -= strength
        push[i] += strength * gap
        push[j] -= strength * gap

    for a, b in adjacency.face.tolist():
        if label[a] != label[b]:
            for vertex in set(faces[a].tolist()) & set(faces[b].tolist()):
                i, j = (int(nodes.corner[f][faces[f] == vertex]) for f in (a, b))
                gap = float(color[j, 0] - color[i, 0])
                spring(i, j, 1 / (1 + gap**2 / 0.01) ** 2, gap)
    for corner in nodes.corner.tolist():
        for k in range(3):
            spring(corner[k], corner[(k + 1) % 3], SMOOTHNESS)
    expected = torch.linalg.solve(dense, push)
    torch.testing.assert_close(offset[:, 0].double(), expected, atol=2e-5, rtol=0)


def test_samples_hit_pixel_centers_and_the_low_band_keeps_ramps() -> None:
    atlas = plane()
    image = noise(1)
    sampler = Sampler(maps_of(atlas, [image]), 0.01)
    points = torch.tensor([[10.5 / WIDTH, 20.5 / HEIGHT, 0.0], [70.5 / WIDTH, 33.5 / HEIGHT, 0.0]])
    grid, depth = sampler.grid(0, points)
    expected = image[[20, 33], [10, 70]].float() / 255
    torch.testing.assert_close(full_band(sampler.image(0), grid), expected, atol=2e-4, rtol=0)
    assert sampler.sees(0, grid, depth + torch.tensor([0.0, 0.1])).tolist() == [True, False]
    ramp = torch.linspace(0, 1, WIDTH)[None, None, None, :].expand(1, 3, HEIGHT, WIDTH)
    torch.testing.assert_close(low_band(ramp, grid), full_band(ramp, grid), atol=2e-3, rtol=0)


def render(atlas: Atlas, images: list[Tensor], label: Tensor) -> Tensor:
    """The texture [SIDE,SIDE,3] that `blend_texels` makes; every view sees every face."""
    texels = map_texels(atlas)
    sees = torch.arange(len(images)).expand(len(label), -1)
    blend = blend_texels(atlas.mesh, texels, label, sees, Sampler(maps_of(atlas, images), 0.01))
    texture = torch.full((SIDE * SIDE, 3), torch.nan)
    texture[texels.texel] = blend.color
    return texture.view(SIDE, SIDE, 3)


def test_a_single_view_is_sampled_as_it_is() -> None:
    atlas, image = plane(), noise(2)
    texture = render(atlas, [image], torch.zeros(len(atlas.mesh.t_pos_idx), dtype=torch.int64))
    torch.testing.assert_close(texture, image.float() / 255, atol=1e-3, rtol=0)


def test_another_exposure_leaves_no_edge_and_detail_stays_that_of_one_view() -> None:
    atlas, image = plane(), noise(3)
    brighter = (image.int() + 12).to(torch.uint8)
    texture = render(atlas, [image, brighter], halves(atlas))
    photo = image.float() / 255
    added = (texture - photo).mean((0, 2)) * 255  # per column: 0 to 12 if nothing were done
    assert float(added.diff().abs().max()) < 2
    middle = slice(SIDE // 2 - 12, SIDE // 2 + 12)
    fine = (texture - photo)[:, middle]
    assert float((fine - fine.mean((0, 2), keepdim=True)).abs().max()) < 0.02, "no blur where both show the same detail"


def test_different_detail_is_not_averaged() -> None:
    """Fine stripes that are shifted by half a period would cancel out in an average of both views."""
    atlas = plane()
    stripes = torch.where(torch.arange(HEIGHT) % 4 < 2, 60, 180).to(torch.uint8)[:, None, None].expand(-1, WIDTH, 3)
    texture = render(atlas, [stripes.contiguous(), stripes.roll(2, 0).contiguous()], halves(atlas))
    contrast = texture[4:-4].amax(0) - texture[4:-4].amin(0)
    assert float(contrast.min()) > 0.4


def test_a_view_does_not_fade_over_faces_that_it_does_not_see() -> None:
    atlas = plane()
    label = halves(atlas)
    images = [torch.full((HEIGHT, WIDTH, 3), value, dtype=torch.uint8) for value in (20, 230)]
    texels = map_texels(atlas)
    sees = label[:, None]
    blend = blend_texels(atlas.mesh, texels, label, sees, Sampler(maps_of(atlas, images), 0.01))
    torch.testing.assert_close(blend.own, torch.ones_like(blend.own))


def test_texels_lie_where_their_uv_say_and_charts_are_continued() -> None:
    atlas = plane()
    small = Mesh(atlas.mesh.v_pos, atlas.mesh.t_pos_idx, atlas.mesh.v_pos[:, :2] * 0.5 + 0.25, atlas.mesh.t_pos_idx)
    texels = map_texels(Atlas(small, SIDE, SIDE, "scan", 1))
    row, column = texels.texel // SIDE, texels.texel % SIDE
    points = surface_points(small, texels)
    expected = torch.stack(((column + 0.5) / SIDE - 0.25, (row + 0.5) / SIDE - 0.25), 1) * 2
    torch.testing.assert_close(points[:, :2], expected, atol=1e-4, rtol=0)
    assert column.min() == SIDE // 4 - 2
    assert row.max() == 3 * SIDE // 4 + 1
    inside = (texels.barycentric >= 0).all(1)
    assert int(inside.sum()) == (SIDE // 2) ** 2


def test_texels_beside_a_sliver_stay_near_it() -> None:
    position = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1e-5, 0.0]])
    uv = torch.tensor([[0.1, 0.50781], [0.9, 0.50781], [0.5, 0.50783]])
    faces = torch.tensor([[0, 1, 2]])
    mesh = Mesh(position, faces, uv, faces)
    texels = map_texels(Atlas(mesh, 64, 64, "scan", 1))
    points = surface_points(mesh, texels)
    assert len(points) > 50
    assert bool(torch.isfinite(points).all())
    assert float((points - position.mean(0)).norm(dim=1).max()) < 3
