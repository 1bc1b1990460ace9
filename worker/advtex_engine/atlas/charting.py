"""Charts by xatlas: cutting a mesh into charts, and packing them into pages. Arrays only, without torch.

A large mesh is cut into parts that are charted in child processes side by side (`runtime/children.py`), and its charts
are packed in one as well: xatlas cannot be interrupted, a child can. Parts consist of whole blocks, the same ones as in
one process, so that the charts depend neither on the number of processes nor on which one made them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xatlas

from advtex_engine.core.monitor import Monitor
from advtex_engine.runtime.children import Arrays, run_in_children

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Texels around each chart, so that twice as many lie between two: bilinear sampling touches one on either side, and
# as much is left at half the size, which coarse pyramid levels sample.
PADDING = 2
# xatlas grows a chart up to this cost; its default of 2 makes a tenth more charts, and more than 8 changes nothing.
CHART_COST = 8.0
# Charts are grown in blocks of at most so many faces: xatlas's time grows faster than a block's size, and blocks run
# side by side on several cores, with the same result. 80k faces: 8 s instead of 22 s on one core, as many charts.
BLOCK_FACES = 3_000
# Above this many faces, children do the work.
LARGE_MESH = 100_000
# Faces per child.
PART_FACES = 50_000
TOO_LARGE = "lower the face budget, or free memory on the machine"


@dataclass(frozen=True)
class Charts:
    """uv [U,2] in chart-local units, face indices into it [T,3], chart of each face [T] (-1 = none)."""

    uv: Floats
    faces: Integers
    chart: Integers


def make_charts(position: npt.NDArray[np.float32], faces: Integers, monitor: Monitor, *, apart: bool = False) -> Charts:
    """Cut a mesh into charts and flatten them. Faces and their corners keep their order.

    position: [V,3] with an average face of one unit of area. apart: in a child process, however small the mesh is, so
    that nothing of this process waits. Raises Stopped when the monitor asks for it, and EngineError when a child
    process died twice.
    """
    if len(faces) <= LARGE_MESH:
        if not apart:
            return _chart_blocks(position, faces)
        whole: Arrays = {"position": position, "faces": faces}
        (made_apart,) = run_in_children("advtex_engine.atlas.charting:chart_part", [whole], 1, monitor, TOO_LARGE)
        return Charts(**made_apart)
    parts = split_faces(position, faces, PART_FACES)
    requests = list[Arrays]()
    for part in parts:
        used, local = np.unique(faces[part], return_inverse=True)
        requests.append({"position": position[used], "faces": local.reshape(-1, 3)})
    made = run_in_children("advtex_engine.atlas.charting:chart_part", requests, _cores(), monitor, TOO_LARGE)
    return _joined(parts, [Charts(**one) for one in made], len(faces))


def chart_part(position: npt.NDArray[np.float32], faces: Integers) -> Arrays:
    """What a child does for `make_charts`."""
    return vars(_chart_blocks(position, faces))


def pack_charts(pages: Sequence[tuple[Floats, Integers]], monitor: Monitor) -> list[tuple[Floats, int]]:
    """Place the charts of each page at their scale, each page by itself.

    pages: uv [U,2] in texels, and faces [T,3] indices into them. Returns texel coordinates [U,2] and the side that
    holds them. Raises as `make_charts` does.
    """
    requests: list[Arrays] = [{"uv": uv, "faces": faces} for uv, faces in pages]
    if sum(len(faces) for _, faces in pages) <= LARGE_MESH:
        packed = [pack_page(uv, faces) for uv, faces in pages]
    else:
        packed = run_in_children("advtex_engine.atlas.charting:pack_page", requests, _cores(), monitor, TOO_LARGE)
    return [(one["texel"], int(one["side"])) for one in packed]


def pack_page(uv: Floats, faces: Integers) -> Arrays:
    """What a child does for `pack_charts`."""
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(uv.astype(np.float32), faces.astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), _pack_options(texels_per_unit=1.0))
    mapping, packed_faces, packed = atlas[0]
    assert atlas.atlas_count == 1
    assert np.array_equal(mapping[packed_faces], faces)
    texel = np.zeros_like(uv)
    texel[mapping] = packed * np.array([atlas.width, atlas.height], dtype=np.float64)
    return {"texel": texel, "side": np.array(max(atlas.width, atlas.height))}


def split_faces(position: npt.NDArray[np.float32], faces: Integers, most: int) -> list[Integers]:
    """Halve a mesh along its longest axis, again and again, until each part has at most `most` faces.

    Returns each part's face indices, ascending.
    """
    centroid = position[faces].mean(axis=1)
    parts, waiting = list[Integers](), [np.arange(len(faces))]
    while waiting:
        part = waiting.pop()
        if len(part) <= most:
            parts.append(part)
            continue
        place = centroid[part]
        axis = int(np.argmax(place.max(axis=0) - place.min(axis=0)))
        order = part[np.argsort(place[:, axis], kind="stable")]
        half = len(order) // 2
        waiting += [np.sort(order[half:]), np.sort(order[:half])]
    return parts


def _chart_blocks(position: npt.NDArray[np.float32], faces: Integers) -> Charts:
    atlas = xatlas.Atlas()
    blocks = split_faces(position, faces, BLOCK_FACES)
    for block in blocks:
        used, local = np.unique(faces[block], return_inverse=True)
        atlas.add_mesh(position[used], local.reshape(-1, 3).astype(np.uint32))
    options = xatlas.ChartOptions()
    options.max_cost = CHART_COST
    atlas.generate(options, _pack_options())
    made = []
    for index, block in enumerate(blocks):
        mapping, local, uv = atlas[index]
        assert np.array_equal(np.unique(faces[block])[mapping[local]], faces[block])
        chart = np.full(len(block), -1, dtype=np.int64)
        for number in range(atlas.get_mesh_chart_count(index)):
            chart[np.asarray(atlas.get_mesh_chart(index, number).faces)] = number
        made.append(Charts(uv * np.array([atlas.width, atlas.height], dtype=np.float64), local.astype(np.int64), chart))
    return _joined(blocks, made, len(faces))


def _joined(parts: list[Integers], made: list[Charts], count: int) -> Charts:
    """The charts of a mesh of `count` faces from those of its parts."""
    faces, chart = np.zeros((count, 3), dtype=np.int64), np.full(count, -1, dtype=np.int64)
    vertices, charts = 0, 0
    for part, one in zip(parts, made, strict=True):
        faces[part] = one.faces + vertices
        chart[part] = np.where(one.chart >= 0, one.chart + charts, -1)
        vertices, charts = vertices + len(one.uv), charts + int(one.chart.max()) + 1
    return Charts(np.concatenate([one.uv for one in made]), faces, chart)


def _pack_options(texels_per_unit: float = 0.0) -> Any:
    """Charts go where there is room first: brute force takes minutes, alignment to blocks costs 5 % of the area.

    xatlas's `resolution` is no cap, so none is given.
    """
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.bilinear = False
    options.blockAlign = False
    options.bruteForce = False
    options.create_image = False
    options.texels_per_unit = texels_per_unit
    return options


def _cores() -> int:
    return len(os.sched_getaffinity(0))
