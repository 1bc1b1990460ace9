"""Candidates on a scene whose answer is known; the random field against brute force and against descent alone."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from advtex_engine.core.scene import Atlas, Camera, Mesh, View
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.selection.candidates import (
    KEPT_VIEWS,
    NO_VIEW,
    POINTS,
    SAFE_DISTANCE,
    Candidates,
    disagreement,
    edge_distance,
    face_points,
    find_candidates,
    frame_blur,
)
from advtex_engine.selection.mrf import (
    Adjacency,
    assign_views,
    descend,
    edge_ends,
    energy,
    face_adjacency,
    seam_costs,
    solve,
)

WIDTH, HEIGHT, FOCAL = 96, 80, 80.0


def grid(cells: int, side: float = 1.0, z: float = 0.0) -> tuple[Tensor, Tensor]:
    """A square of cells x cells quads about the origin at height z: positions and faces."""
    line = torch.linspace(-side / 2, side / 2, cells + 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack((x, y, torch.full_like(x, z)), 2).view(-1, 3)
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    return position, torch.cat((torch.stack((a, b, c), 1), torch.stack((a, c, d), 1)))


def camera_above(x: float, y: float, height: float) -> Camera:
    """Looks straight down on the plane z = 0 (world z up, image x along world x)."""
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, height], dtype=torch.float64)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, WIDTH, HEIGHT)


def camera_below(x: float, y: float, depth: float) -> Camera:
    """Looks straight up at the plane z = 0."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor([x, y, -depth], dtype=torch.float64)
    return Camera(camera_above(0, 0, 1).K, pose, WIDTH, HEIGHT)


def maps_of(mesh: Mesh, cameras: list[Camera], images: list[Tensor] | None = None) -> ViewMaps:
    """View maps with gray images unless given."""
    gray = torch.full((HEIGHT, WIDTH, 3), 128, dtype=torch.uint8)
    images = images or [gray] * len(cameras)
    views = tuple(View(f"{i}", camera, image) for i, (camera, image) in enumerate(zip(cameras, images, strict=True)))
    uv = mesh.v_pos[:, :2] - mesh.v_pos[:, :2].amin(0)
    mesh = Mesh(mesh.v_pos, mesh.t_pos_idx, uv / uv.max(), mesh.t_pos_idx)
    return build_view_maps(Atlas(mesh, 64, 64, "scan", 1), views, "object")


# Candidates -----------------------------------------------------------------------------------------------------------


def test_neighbors_share_the_points_of_their_edge() -> None:
    position, faces = grid(3)
    points = face_points(Mesh(position, faces))
    adjacency = face_adjacency(faces)
    assert len(points.position) == 16 + 33 + 18  # vertices, edges, faces
    for number in (0, 1):
        face, side = adjacency.face[:, number], adjacency.side[:, number]
        ends = position[faces[face].gather(1, edge_ends(faces, adjacency, number))]
        torch.testing.assert_close(points.position[points.index[face, side + 3]], ends.mean(1))
    both = [points.index[adjacency.face[:, k], adjacency.side[:, k] + 3] for k in (0, 1)]
    assert torch.equal(both[0], both[1])
    torch.testing.assert_close(points.position[points.index[:, 6]], position[faces].mean(1))


def test_the_nearer_view_is_better_and_a_hidden_or_outlying_face_has_none() -> None:
    floor, faces = grid(8, side=0.6)
    lid, more = grid(1, side=0.2, z=0.5)
    mesh = Mesh(torch.cat((floor, lid)), torch.cat((faces, more + len(floor))))
    near, far = camera_above(0.0, 0.0, 1.0), camera_above(0.0, 0.0, 1.4)
    candidates = find_candidates(mesh, maps_of(mesh, [far, near]), 0.01)
    middle = mesh.v_pos[faces].mean(1)[:, :2].abs().amax(1)
    shown, hidden = (middle > 0.24), (middle < 0.1)
    assert bool((candidates.view[:128][hidden] < 0).all()), "the lid hides the floor below it"
    assert bool(((candidates.view[:128][shown] >= 0).sum(1) == 2).all())
    cost = candidates.cost[:128][shown]
    view = candidates.view[:128][shown]
    assert bool((view.gather(1, cost.argmin(1)[:, None]) == 1).all())
    # Twice as near shows an edge twice as long: the data term is a logarithm of lengths.
    gain = cost.sort(1).values[:, 1] - cost.sort(1).values[:, 0]
    assert 0.2 < float(gain.median()) < 0.8
    elsewhere = find_candidates(mesh, maps_of(mesh, [near, camera_above(5.0, 0.0, 1.0)]), 0.01)
    assert not bool((elsewhere.view == 1).any())
    assert bool((elsewhere.cost[elsewhere.view < 0] == NO_VIEW).all())


@pytest.mark.parametrize("turned", [False, True], ids=["as scanners write it", "turned inside out"])
def test_the_far_side_of_a_thin_wall_is_not_painted_with_what_its_near_side_shows(turned: bool) -> None:
    floor, faces = grid(8, side=0.6)
    under = torch.cat((faces, faces.flip(1) + len(floor)))
    mesh = Mesh(torch.cat((floor, floor - torch.tensor([0.0, 0.0, 0.002]))), under.flip(1) if turned else under)
    above, below = camera_above(0.0, 0.0, 0.7), camera_below(0.0, 0.0, 2.0)
    candidates = find_candidates(mesh, maps_of(mesh, [above, below]), 0.01)
    best = candidates.view.gather(1, candidates.cost.argmin(1)[:, None])[:, 0]
    assert bool((best[:128] == 0).all())
    assert bool((best[128:] == 1).all()), "it is better seen, were it not for the wall, from the other side"


def test_where_windings_are_mixed_both_sides_of_a_face_count() -> None:
    position, faces = grid(8, side=0.6)
    mixed = torch.where((torch.arange(128) % 2 == 0)[:, None], faces, faces.flip(1))
    maps = maps_of(Mesh(position, faces), [camera_above(0.0, 0.0, 1.0)])
    one_way, both_ways = (find_candidates(Mesh(position, some), maps, 0.01) for some in (faces, mixed))
    torch.testing.assert_close(one_way.cost, both_ways.cost)


def test_only_the_best_views_are_kept_whatever_their_order() -> None:
    position, faces = grid(2, side=0.2)
    mesh = Mesh(position, faces)
    heights = torch.linspace(0.8, 2.0, KEPT_VIEWS + 6)
    order = torch.randperm(len(heights), generator=torch.Generator().manual_seed(3))
    cameras = [camera_above(0.0, 0.0, float(heights[index])) for index in order]
    candidates = find_candidates(mesh, maps_of(mesh, cameras), 0.01)
    kept = order[candidates.view].sort(1).values
    assert torch.equal(kept, torch.arange(KEPT_VIEWS).expand(len(faces), -1))


def test_distance_from_depth_edges_is_measured_in_pixels() -> None:
    depth = torch.full((40, 60), 2.0)
    depth[:, 30:] = 2.5
    depth[20, 10] = 0
    distance = edge_distance(depth)
    assert distance[20, 10] == 0
    assert distance[20, 13] == 3
    assert distance[0, 20] == 1
    assert distance[10, 29] == distance[10, 30] == 0
    assert distance[10, 34] == 4
    assert distance[20, 45] == SAFE_DISTANCE
    slanted = torch.linspace(2, 3, 60).expand(40, 60)
    assert edge_distance(slanted)[20, 30] == SAFE_DISTANCE, "a slant is no edge"


def test_a_blurred_frame_is_recognized() -> None:
    position, faces = grid(1, side=0.5)
    sharp = torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    rolled = [sharp.roll(step, 1) for step in range(4)]
    mixed = torch.stack([sharp.roll(step, 1).float() for step in range(5)]).mean(0)
    maps = maps_of(Mesh(position, faces), [camera_above(0.0, 0.0, 1.0)] * 5, [*rolled, mixed.to(torch.uint8)])
    blur = frame_blur(maps)
    assert float(blur[4]) > 0.3
    assert float(blur[:4].max()) < 0.02


def test_the_odd_view_out_disagrees_and_missing_views_do_not_count() -> None:
    color = torch.full((1, 6, POINTS, 3), 100, dtype=torch.uint8)
    color[0, 2] = 220
    color[0, 5] = 0
    valid = torch.tensor([[True, True, True, True, True, False]])
    found = disagreement(color, valid)
    assert found[0, 2] > 1
    assert float(found[0, [0, 1, 3, 4]].max()) < 0.1
    assert found[0, 5] == 0


# The random field -----------------------------------------------------------------------------------------------------


def random_field(nodes: int, labels: int, extra: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """A tree with `extra` further edges, random costs."""
    generator = torch.Generator().manual_seed(seed)
    parents = [(int(torch.randint(0, node, (), generator=generator)), node) for node in range(1, nodes)]
    loops = torch.randint(0, nodes, (extra, 2), generator=generator).tolist()
    pairs = sorted(set(parents) | {(min(pair), max(pair)) for pair in loops if pair[0] != pair[1]})
    unary = torch.rand((nodes, labels), generator=generator)
    return unary, torch.tensor(pairs), torch.rand((len(pairs), labels, labels), generator=generator)


def brute_force(unary: Tensor, pairs: Tensor, pairwise: Tensor) -> float:
    """Energy of the best labeling, by trying all."""
    choices = itertools.product(range(unary.shape[1]), repeat=len(unary))
    return min(plain_energy(choice, unary, pairs, pairwise) for choice in choices)


def plain_energy(choice: tuple[int, ...], unary: Tensor, pairs: Tensor, pairwise: Tensor) -> float:
    data = sum(float(unary[node, label]) for node, label in enumerate(choice))
    return data + sum(float(pairwise[e, choice[a], choice[b]]) for e, (a, b) in enumerate(pairs.tolist()))


@settings(deadline=None, max_examples=25)
@given(st.integers(2, 6), st.integers(1, 3), st.integers(0, 2**31 - 1))
def test_trees_are_solved_exactly(nodes: int, labels: int, seed: int) -> None:
    field = random_field(nodes, labels, 0, seed)
    choice = solve(*field)
    assert float(energy(choice, *field)) == pytest.approx(plain_energy(tuple(choice.tolist()), *field), abs=1e-5)
    assert float(energy(choice, *field)) == pytest.approx(brute_force(*field), abs=1e-5)


def test_small_graphs_with_loops_are_solved_nearly_exactly() -> None:
    gaps = []
    for seed in range(30):
        field = random_field(6, 3, 4, seed)
        best = brute_force(*field)
        gaps.append(float(energy(solve(*field), *field)) / best - 1)
    assert max(gaps) < 0.15
    assert sum(gap < 1e-5 for gap in gaps) >= 24


@settings(deadline=None, max_examples=25)
@given(st.integers(2, 30), st.integers(2, 5), st.integers(0, 40), st.integers(0, 2**31 - 1))
def test_descent_ends_where_no_single_change_helps(nodes: int, labels: int, extra: int, seed: int) -> None:
    field = random_field(nodes, labels, extra, seed)
    start = torch.randint(0, labels, (nodes,), generator=torch.Generator().manual_seed(seed))
    choice = descend(start, *field)
    reached = float(energy(choice, *field))
    assert reached <= float(energy(start, *field)) + 1e-5
    for node, label in itertools.product(range(nodes), range(labels)):
        changed = choice.clone()
        changed[node] = label
        assert float(energy(changed, *field)) > reached - 1e-4


def test_messages_find_what_descent_alone_does_not() -> None:
    """Noisy data of two halves of a mesh, and seams that cost: the halves come out whole."""
    position, faces = grid(24)
    adjacency = face_adjacency(faces)
    half = (position[faces].mean(1)[:, 0] > 0).long()
    generator = torch.Generator().manual_seed(5)
    unary = torch.rand((len(faces), 4), generator=generator) * 1.6
    unary[torch.arange(len(faces)), half] -= 0.5
    pairwise = (1 - torch.eye(4)).expand(len(adjacency.face), 4, 4)
    alone = descend(unary.argmin(1), unary, adjacency.face, pairwise)
    found = solve(unary, adjacency.face, pairwise)
    wrong = int((found != half).sum())
    assert float(energy(found, unary, adjacency.face, pairwise)) < float(energy(alone, unary, adjacency.face, pairwise))
    assert wrong < 0.25 * int((alone != half).sum())


# Seams ----------------------------------------------------------------------------------------------------------------


def test_adjacency_is_that_of_a_plain_search() -> None:
    _, faces = grid(4)
    faces = torch.cat((faces, torch.tensor([[0, 1, 24]])))  # a third face on one edge
    edges: dict[frozenset[int], list[int]] = {}
    for face, corners in enumerate(faces.tolist()):
        for side in range(3):
            edges.setdefault(frozenset((corners[side], corners[(side + 1) % 3])), []).append(face)
    expected = sorted(pair for users in edges.values() for pair in itertools.pairwise(users))
    assert sorted(map(tuple, face_adjacency(faces).face.tolist())) == expected


def two_faces(views: list[list[int]], color: Tensor) -> tuple[Tensor, Candidates]:
    """Two triangles on the edge 1-2, of opposite order, with candidate views and their colors [2,K,7,3]."""
    view = torch.tensor(views)
    cost = torch.where(view >= 0, 0.0, NO_VIEW)
    return torch.tensor([[0, 1, 2], [2, 1, 3]]), Candidates(view, cost, torch.zeros(view.shape), color)


def test_a_seam_costs_what_the_views_differ_along_it() -> None:
    color = torch.zeros((2, 3, POINTS, 3), dtype=torch.uint8)
    color[0, 0, 1], color[1, 0, 1] = 90, 90  # the shared end, vertex 1: corner 1 of either face
    color[0, 0, 2], color[1, 1, 0] = 200, 200  # vertex 2: corner 2 of the first, corner 0 of the second
    faces, candidates = two_faces([[5, 7, 9], [5, 6, 9]], color)
    adjacency = face_adjacency(faces)
    cost = seam_costs(faces, candidates, adjacency)
    assert adjacency.face.tolist() == [[0, 1]]
    assert cost[0, 0, 0] == cost[0, 2, 2] == 0, "one view on both sides is no seam"
    plain = float(cost[0, 1, 2])
    assert plain > 0, "views that agree still make a seam"
    assert cost[0, 0, 1] > plain
    assert cost[0, 1, 0] > plain
    assert cost[0, 0, 2] > cost[0, 0, 1], "more places differ"


def test_faces_that_nobody_sees_have_no_view_and_hold_up_nobody() -> None:
    color = torch.zeros((2, 2, POINTS, 3), dtype=torch.uint8)
    faces, candidates = two_faces([[-1, -1], [3, -1]], color)
    found = assign_views(Mesh(torch.rand(4, 3), faces), candidates)
    assert found.view.tolist() == [-1, 3]
    assert found.agreement[1] == 1


def test_a_face_of_no_area_is_painted_by_who_sees_it() -> None:
    """The empty place beside it would have the neighbor's color, and so the cheaper seam."""
    color = torch.zeros((2, 2, POINTS, 3), dtype=torch.uint8)
    color[1, 0] = 200
    faces, candidates = two_faces([[5, -1], [3, -1]], color)
    position = torch.tensor([[0.0, 1, 0], [0, 0, 0], [2, 0, 0], [1, 0, 0]])
    assert assign_views(Mesh(position, faces), candidates).view.tolist() == [5, 3]


def test_one_face_alone() -> None:
    color = torch.zeros((1, 2, POINTS, 3), dtype=torch.uint8)
    candidates = Candidates(torch.tensor([[4, 2]]), torch.tensor([[1.0, 0.5]]), torch.zeros((1, 2)), color)
    assert assign_views(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])), candidates).view.tolist() == [2]
    none = torch.zeros((0, 2), dtype=torch.int64)
    assert torch.equal(face_adjacency(torch.tensor([[0, 1, 2]])).face, Adjacency(none, none).face)


@pytest.mark.parametrize("cuts", [1, 2, 8])
def test_who_paints_a_door_does_not_depend_on_how_it_is_cut_into_faces(cuts: int) -> None:
    """View 0 shows the wall, and the door a little worse than view 1 does, which is worth a seam all around."""
    half = torch.linspace(0.5, 1.5, 9)
    line = torch.cat((-half.flip(0), torch.linspace(-0.5, 0.5, cuts + 1)[1:-1], half))
    y, x = torch.meshgrid(line, line, indexing="ij")
    position, (_, faces) = torch.stack((x, y, torch.zeros_like(x)), 2).view(-1, 3), grid(len(line) - 1)
    door = position[faces].mean(1).abs().amax(1) < 0.5
    cost = torch.where(door[:, None], torch.tensor([5.0, 0.0]), torch.tensor([0.0, 5.0]))
    view, color = torch.tensor([0, 1]).repeat(len(faces), 1), torch.zeros((len(faces), 2, POINTS, 3), dtype=torch.uint8)
    found = assign_views(Mesh(position, faces), Candidates(view, cost, torch.zeros_like(cost), color))
    assert torch.equal(found.view, door.long())
