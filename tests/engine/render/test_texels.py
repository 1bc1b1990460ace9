"""Every texel that a render reads belongs to a face, however thin that is."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.render.texels import map_texels
from advtex_engine.render.texture import bilinear_footprint

SIDE = 64


def _atlas(corners: torch.Tensor) -> Atlas:
    """Faces that lie in the plane as they lie in the texture; corners: [T,3,2] texels."""
    flat = corners.reshape(-1, 2).float()
    index = torch.arange(len(flat)).view(-1, 3)
    position = torch.cat((flat, torch.ones_like(flat[:, :1])), 1)
    return Atlas(Mesh(position, index, flat / SIDE, index), SIDE, SIDE, "xatlas", len(index))


@given(
    ends=st.lists(st.tuples(st.floats(8, 56), st.floats(8, 56)), min_size=2, max_size=2),
    aside=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    along=st.floats(0, 1),
)
def test_all_that_a_render_reads_of_a_thin_chart_is_mapped(
    ends: list[tuple[float, float]], aside: tuple[float, float], along: float
) -> None:
    start, end = torch.tensor(ends, dtype=torch.float64)
    third = torch.lerp(start, end, along) + torch.tensor(aside, dtype=torch.float64)
    corners = torch.stack((start, end, third))[None]
    texels = map_texels(_atlas(corners))
    weights = torch.distributions.Dirichlet(torch.ones(3)).sample((200,)).double()
    weights = torch.cat((weights, torch.eye(3, dtype=torch.float64)))
    read, share = bilinear_footprint((weights @ corners[0]).float(), SIDE, SIDE)
    assert torch.isin(read[share > 1e-4], texels.texel).all()


def test_a_chart_between_the_centers_of_texels_has_texels() -> None:
    strip = [[[10.6, 20.7], [15.4, 20.7], [10.6, 21.3]], [[15.4, 20.7], [15.4, 21.3], [10.6, 21.3]]]
    texels = map_texels(_atlas(torch.tensor(strip)))
    rows, columns = texels.texel // SIDE, texels.texel % SIDE
    assert {(20, column) for column in range(10, 16)} <= set(zip(rows.tolist(), columns.tolist(), strict=True))
    assert set(texels.face.tolist()) == {0, 1}


def test_a_thin_face_takes_no_texel_of_another() -> None:
    beside = [[[4.0, 4.0], [30.0, 4.0], [4.0, 30.0]], [[4.0, 4.0], [30.0, 4.0], [17.0, 3.6]]]
    alone = map_texels(_atlas(torch.tensor(beside[:1])))
    both = map_texels(_atlas(torch.tensor(beside)))
    inside = alone.texel[alone.barycentric.amin(1) >= 0]
    assert (both.face[torch.isin(both.texel, inside)] == 0).all()
