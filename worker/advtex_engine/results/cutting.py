"""Some faces of a textured model with an image of their own, whose texels are copies of the model's.

Charts are cut along faces. What is left of each is moved by whole texels, so that nothing is sampled anew, and a texel
that lies on two parts has the same color on both.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.atlas.build import uv_islands
from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.render.texels import REACH, map_texels
from advtex_engine.render.texture import fill_holes
from advtex_engine.results.baking import TexturedModel
from advtex_engine.results.pages import Page

Integers = NDArray[np.int64]


def cut_out(model: TexturedModel, faces: Tensor) -> Page:
    """The faces [N] of a model, at least one, with their texels and REACH more around them; the rest is filled.

    The page's mesh keeps all positions of the model, so that normals of its vertices serve the page as well.
    """
    mesh, width, height = model.atlas.mesh, model.atlas.width, model.atlas.height
    assert mesh.v_uv is not None and mesh.t_uv_idx is not None and len(faces)
    used, corners = torch.unique(mesh.t_uv_idx[faces], return_inverse=True)
    texel = mesh.v_uv[used].double().numpy() * (width, height)
    island = uv_islands(corners.numpy())
    count = int(island.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in texel[corners.numpy()].swapaxes(0, 1):
        np.minimum.at(low, island, corner)
        np.maximum.at(high, island, corner)
    first = np.floor(low).astype(np.int64) - REACH
    place, size = pack_boxes(np.ceil(high).astype(np.int64) + REACH - first)
    shift = place - first
    of_uv = np.zeros(len(used), np.int64)
    of_uv[corners.numpy()] = island[:, None]
    uv = torch.from_numpy(((texel + shift[of_uv]) / size).astype(np.float32))
    part = Mesh(mesh.v_pos, mesh.t_pos_idx[faces], uv, corners)
    atlas = Atlas(part, int(size[0]), int(size[1]), model.atlas.source, count)
    shown = map_texels(atlas)
    moved = torch.from_numpy(shift)[torch.from_numpy(island)[shown.face]]
    column = (shown.texel % atlas.width - moved[:, 0]).clamp(0, width - 1)
    row = (shown.texel // atlas.width - moved[:, 1]).clamp(0, height - 1)
    image = torch.zeros((atlas.height * atlas.width, 3))
    known = torch.zeros(len(image), dtype=torch.bool)
    image[shown.texel], known[shown.texel] = model.texture[row, column].float(), True
    filled = fill_holes(image.view(atlas.height, atlas.width, 3), known.view(atlas.height, atlas.width))
    return Page(part, filled.round().to(torch.uint8), "")


def pack_boxes(sizes: Integers) -> tuple[Integers, Integers]:
    """Boxes [N,2] (width, height) in rows of falling height: their first corners [N,2], and the size [2] of it all."""
    across = max(int(sizes[:, 0].max()), int(np.ceil(np.sqrt(sizes.prod(axis=1).sum()))))
    place, x, y, row = np.zeros_like(sizes), 0, 0, 0
    for index in np.argsort(-sizes[:, 1], kind="stable").tolist():
        width, height = sizes[index].tolist()
        if x + width > across:
            x, y, row = 0, y + row, 0
        row = max(row, height)
        place[index] = x, y
        x += width
    return place, np.array([across, y + row])
