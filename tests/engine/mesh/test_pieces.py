"""Connected pieces and open borders, against plain twins."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.borders import border
from advtex_engine.mesh.pieces import pieces

VERTICES = 12
TRIANGLES = st.lists(
    st.lists(st.integers(0, VERTICES - 1), min_size=3, max_size=3, unique=True), min_size=1, max_size=20
)


def made(faces: list[list[int]]) -> Mesh:
    position = np.random.default_rng(0).normal(size=(VERTICES, 3)).astype(np.float32)
    return Mesh(torch.from_numpy(position), torch.tensor(faces))


@given(TRIANGLES)
def test_a_piece_is_what_faces_connect(faces: list[list[int]]) -> None:
    group = {vertex: {vertex} for vertex in range(VERTICES)}
    for face in faces:
        joined = set[int]().union(*(group[vertex] for vertex in face))
        group |= dict.fromkeys(joined, joined)
    assert pieces(made(faces)).tolist() == [min(group[vertex]) for vertex in range(VERTICES)]


def test_a_long_strip_is_one_piece_whatever_its_vertices_are_called() -> None:
    count = 5_000
    name = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    first = torch.arange(count - 2)
    mesh = Mesh(torch.zeros((count, 3)), name[torch.stack((first, first + 1, first + 2), 1)])
    assert pieces(mesh).tolist() == [0] * count


@given(TRIANGLES)
def test_the_border_is_of_edges_that_one_face_has(faces: list[list[int]]) -> None:
    mesh = made(faces)
    edges = [(face[k], face[(k + 1) % 3]) for face in faces for k in range(3)]
    uses = Counter(frozenset(edge) for edge in edges)
    alone = [(number, edge) for number, edge in enumerate(edges) if uses[frozenset(edge)] == 1]
    found, normals = border(mesh.v_pos.numpy(), mesh.t_pos_idx.numpy())
    assert found.tolist() == [list(edge) for _, edge in alone]
    for (number, _), normal in zip(alone, normals, strict=True):
        a, b, c = mesh.v_pos.double().numpy()[faces[number // 3]]
        assert np.allclose(normal, np.cross(b - a, c - a))
