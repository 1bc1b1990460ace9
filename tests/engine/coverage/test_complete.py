"""What is seen, guessed and unseen, and the colors of what is not seen, on surfaces where the answer is known."""

from __future__ import annotations

import heapq
import math

import pytest
import torch
from torch import Tensor

from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.coverage import GUESSED, SEEN, UNSEEN, complete_texture
from advtex_engine.coverage.complete import GUESS_REACH
from advtex_engine.coverage.smooth_surface import FOLD, cut_at_folds, distances, harmonic
from advtex_engine.render.texels import map_texels, surface_points
from advtex_engine.render.texture import fill_holes

SIDE = 64
RED, GREEN = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])


def patch(corner: tuple[float, ...], along: tuple[float, ...], up: tuple[float, ...], cells: int = 4) -> Mesh:
    """A flat grid of cells x cells quads, from its corner along two sides."""
    x, y = torch.meshgrid(torch.arange(cells + 1) / cells, torch.arange(cells + 1) / cells, indexing="xy")
    sides = torch.tensor([along, up], dtype=torch.float32)
    position = torch.tensor(corner, dtype=torch.float32) + torch.stack((x, y), 2).view(-1, 2) @ sides
    a = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    return Mesh(position, torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1))))


def welded(patches: list[Mesh]) -> Mesh:
    """The patches as one mesh, whose vertices are one where they have one place."""
    position = torch.cat([mesh.v_pos for mesh in patches])
    starts = torch.tensor([len(mesh.v_pos) for mesh in patches]).cumsum(0)
    faces = torch.cat([mesh.t_pos_idx + start - len(mesh.v_pos) for mesh, start in zip(patches, starts, strict=True)])
    places, index = torch.unique((position * 1e5).round(), dim=0, return_inverse=True)
    first = torch.full((len(places),), len(position)).scatter_reduce_(0, index, torch.arange(len(position)), "amin")
    return Mesh(position[first], index[faces])


def charted(patches: list[Mesh], cells: list[tuple[int, int]], along: int, cell: int = 20) -> Atlas:
    """Each patch a square chart of cell - 4 texels in the cell (column, row) of the texture."""
    mesh = welded(patches)
    uv, uv_faces, count = [], [], 0
    for one, place in zip(patches, cells, strict=True):
        side = math.isqrt(len(one.v_pos))
        x, y = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="xy")
        inside = torch.stack((x, y), 2).view(-1, 2) / (side - 1) * (cell - 4) + 2
        uv.append((inside + torch.tensor(place) * cell) / along)
        uv_faces.append(one.t_pos_idx + count)
        count += len(one.v_pos)
    return Atlas(Mesh(mesh.v_pos, mesh.t_pos_idx, torch.cat(uv), torch.cat(uv_faces)), along, along, "scan", len(cells))


def painted(atlas: Atlas, faces: dict[int, Tensor], each: int = 32) -> tuple[Tensor, Tensor]:
    """A texture with the patches of these numbers in a color, and where it is known; all else is white."""
    texels = map_texels(atlas)
    texture, known = torch.ones(SIDE * SIDE, 3), torch.zeros(SIDE * SIDE, dtype=torch.bool)
    for number, color in faces.items():
        mine = texels.texel[texels.face // each == number]
        texture[mine], known[mine] = color, True
    return texture.view(SIDE, SIDE, 3), known.view(SIDE, SIDE)


FLOOR = patch((0, 0, 0), (1, 0, 0), (0, 1, 0))
BESIDE = patch((1, 0, 0), (1, 0, 0), (0, 1, 0))  # flat, on the right of it
APART = patch((0, 0, 5), (1, 0, 0), (0, 1, 0))
WALL = patch((1, 0, 0), (0, 0, 1), (0, 1, 0))  # meets the floor where BESIDE does


def colors_of(atlas: Atlas, texture: Tensor, number: int) -> Tensor:
    texels = map_texels(atlas)
    return texture.view(-1, 3)[texels.texel[texels.face // 32 == number]]


def test_a_guess_comes_over_the_seam_and_not_from_the_chart_beside_it() -> None:
    # The second patch's chart lies beside the red one, far from that of its neighbor on the surface.
    atlas = charted([FLOOR, BESIDE, APART], [(0, 0), (2, 2), (1, 2)], SIDE)
    texture, known = painted(atlas, {0: GREEN, 2: RED})
    guessed = colors_of(atlas, complete_texture(atlas, texture, known).texture, 1)
    torch.testing.assert_close(guessed, GREEN.expand_as(guessed), atol=2e-3, rtol=0)
    by_image = colors_of(atlas, fill_holes(texture, known), 1)
    assert (by_image - GREEN).abs().max() > 0.3, "in the texture the red one is nearer"


def test_no_guess_passes_a_fold() -> None:
    atlas = charted([FLOOR, WALL, APART], [(0, 0), (2, 2), (1, 2)], SIDE)
    texture, known = painted(atlas, {0: GREEN, 2: RED})
    completed = complete_texture(atlas, texture, known)
    wall = colors_of(atlas, completed.texture, 1)
    torch.testing.assert_close(wall, ((GREEN + RED) / 2).expand_as(wall), atol=1e-4, rtol=0)
    assert completed.shares == pytest.approx({"seen": 2 / 3, "guessed": 0.0, "unseen": 1 / 3}, abs=1e-6)
    assert completed.faces.tolist() == [True] * 32 + [False] * 32 + [True] * 32


def test_what_is_seen_stays_and_what_is_not_goes_on_from_it() -> None:
    atlas = charted([FLOOR], [(0, 0)], SIDE, cell=64)
    texture = torch.linspace(0.2, 0.8, SIDE)[None, :, None].expand(SIDE, SIDE, 3).clone()
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    hole = (x - 30) ** 2 + (y - 34) ** 2 < 12**2
    damaged = torch.where(hole[..., None], torch.tensor(1.0), texture)
    completed = complete_texture(atlas, damaged, ~hole).texture
    assert torch.equal(completed[~hole], texture[~hole])
    # A slope goes on across the hole; its mean would be off by .11 at the border.
    assert (completed - texture)[hole].abs().max() < 0.03


def test_states_follow_the_distance_on_the_surface() -> None:
    atlas = charted([FLOOR], [(0, 0)], SIDE, cell=64)
    texels = map_texels(atlas)
    points = surface_points(atlas.mesh, texels)
    seen = torch.zeros(SIDE * SIDE, dtype=torch.bool)
    seen[texels.texel[points[:, 0] < 0.4]] = True
    completed = complete_texture(atlas, torch.rand(SIDE, SIDE, 3), seen.view(SIDE, SIDE))
    state, texel = completed.state.flatten()[texels.texel], 1 / 60
    assert bool((state[points[:, 0] < 0.4] == SEEN).all())
    beside = points[:, 0] - points[points[:, 0] < 0.4, 0].max()
    inside = texels.barycentric.amin(1) >= 0
    assert bool((state[inside & (beside > 0) & (beside < GUESS_REACH - 1e-4)] == GUESSED).all())
    assert bool((state[beside > GUESS_REACH + 1e-4] == UNSEEN).all())
    assert completed.shares["seen"] == pytest.approx(0.4, abs=texel)
    assert completed.shares["guessed"] == pytest.approx(GUESS_REACH, abs=texel)
    assert sum(completed.shares.values()) == pytest.approx(1)
    gray = complete_texture(atlas, completed.texture, seen.view(SIDE, SIDE), gray=True).texture.view(-1, 3)
    assert bool((gray[texels.texel[state == UNSEEN]] == 0.5).all())
    assert bool((gray[texels.texel[state != UNSEEN]] != 0.5).any(1).all())


def test_a_model_of_which_nothing_is_seen_is_gray_and_unseen() -> None:
    atlas = charted([FLOOR], [(0, 0)], SIDE, cell=64)
    completed = complete_texture(atlas, torch.rand(SIDE, SIDE, 3), torch.zeros(SIDE, SIDE, dtype=torch.bool))
    assert completed.shares == {"seen": 0.0, "guessed": 0.0, "unseen": pytest.approx(1.0)}
    assert not completed.faces.any()
    assert bool((completed.texture.view(-1, 3)[map_texels(atlas).texel] == 0.5).all())


def bumpy(seed: int = 0) -> Mesh:
    mesh = patch((0, 0, 0), (1, 0, 0), (0, 1, 0), cells=9)
    noise = torch.rand(mesh.v_pos.shape, generator=torch.Generator().manual_seed(seed)) * 0.02
    return Mesh(mesh.v_pos + noise, mesh.t_pos_idx)


def test_harmonic_values_are_the_dense_solution() -> None:
    surface = cut_at_folds(bumpy())
    count = len(surface.position)
    generator = torch.Generator().manual_seed(1)
    known, value = torch.rand(count, generator=generator) < 0.1, torch.rand(count, 3, generator=generator)
    found, has = harmonic(surface, value, known)
    matrix = torch.zeros(count, count, dtype=torch.float64)
    for a, b in surface.edges.tolist():
        weight = 1 / float((surface.position[a] - surface.position[b]).norm())
        for one, other in ((a, b), (b, a)):
            matrix[one, one] += weight
            matrix[one, other] -= weight
    matrix[known] = torch.eye(count, dtype=torch.float64)[known]
    plain = torch.linalg.solve(matrix, torch.where(known[:, None], value, 0.0).double())
    assert bool(has.all())
    torch.testing.assert_close(found.double(), plain, atol=2e-3, rtol=0)


def test_distances_are_those_of_dijkstra() -> None:
    surface = cut_at_folds(bumpy(2))
    sources, reach = {3: 0.02, 77: 0.0}, 0.5
    start = torch.full((len(surface.position),), torch.inf)
    start[list(sources)] = torch.tensor(list(sources.values()))
    plain, queue = dict[int, float](), [(far, vertex) for vertex, far in sources.items()]
    while queue:
        far, vertex = heapq.heappop(queue)
        if vertex in plain or far > reach:
            continue
        plain[vertex] = far
        for a, b in surface.edges.tolist():
            if vertex in (a, b):
                other = a + b - vertex
                heapq.heappush(queue, (far + float((surface.position[a] - surface.position[b]).norm()), other))
    expected = torch.tensor([plain.get(vertex, math.inf) for vertex in range(len(start))])
    assert 10 < len(plain) < len(start)
    torch.testing.assert_close(distances(surface, start, reach), expected)


@pytest.mark.parametrize("turned", [False, True], ids=["one winding", "opposite windings"])
@pytest.mark.parametrize(("degrees", "pieces"), [(FOLD - 2, 1), (FOLD + 2, 2)])
def test_edges_that_turn_further_are_folds(degrees: float, pieces: int, turned: bool) -> None:
    angle = math.radians(degrees)
    slope = patch((1, 0, 0), (math.cos(angle), 0, math.sin(angle)), (0, 1, 0))
    mesh = welded([FLOOR, Mesh(slope.v_pos, slope.t_pos_idx.flip(1) if turned else slope.t_pos_idx)])
    surface = cut_at_folds(mesh)
    assert len(surface.position) == len(mesh.v_pos) + 5 * (pieces - 1)
    assert torch.equal(surface.position[surface.corners], mesh.v_pos[mesh.t_pos_idx])
