"""A model as a 3D Tiles 1.1 tileset: GLB tiles cut in space at several levels of detail, in one 3TZ archive.

Level 0 is the full model; each one after it has a quarter of the faces and texels of the one before, decimated and
painted as a whole. The last one fits in one tile, the root; from there on a tile is replaced by about four of the next
finer level, down to the full model. Tiles have whole faces of a level, each face in one tile: neighbors of one level
share their border's vertices, normals and texels, so that no crack opens between them.

Frames: vertices of tiles are in the scan's world. A tile's node turns the scan's up axis to glTF's +y, and viewers of
3D Tiles turn glTF's +y to the tileset's +z. Bounding boxes are in the tileset's frame; no tile has a transform.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import TO_Y_UP, Atlas
from advtex_engine.results.archive import tileset_archive
from advtex_engine.results.baking import TexturedModel, smaller
from advtex_engine.results.cells import Cell, Level, distance_of_faces
from advtex_engine.results.cutting import cut_out
from advtex_engine.results.export import write_pages
from advtex_engine.results.images import JPEG_QUALITY
from advtex_engine.runtime.files import json_text

TILE_BYTES = 3_000_000
"""No tile's file is larger."""
MAX_SIDE = 16384
QUARTER, LEAST_FACES = 4, 200
LEAST_SHRINKING = 0.9  # beyond that share of its bytes the next level is none: its pieces do not decimate
SURELY = 3  # times as many bytes as a tile may have: a level that is thought to have more is not tried as one
QUALITIES = (80, 60, 40)
"""Of JPEGs, tried until a tile that cannot be cut is small enough."""
THINNEST = 1e-3  # metres: a box has a volume

Tile = dict[str, Any]


def write_tiles(
    out: Path,
    atlas: Atlas,
    texture: Tensor,
    *,
    up_axis: str,
    name: str = "model",
    most: int = TILE_BYTES,
    monitor: Monitor | None = None,
) -> Path:
    """Write `name`.3tz, an archive of tileset.json and the tiles; -> its path. texture: as `export_model` takes it.

    most: bytes of a tile's file. A tile's geometric error is in metres: how far its surface and the full model's are
    apart, at corners and centers of the faces of both, or the side of its texels where that is more; it is 0 for tiles
    of the full model, and never less than that of a tile below. Raises Stopped when the monitor asks for it.
    """
    path = out / f"{name}.3tz"
    with tempfile.TemporaryDirectory(prefix="advtex-tiles-") as folder, tileset_archive(path) as add:
        tiler = _Tiler(up_axis, most, add, Path(folder, "tile.glb"), monitor or Monitor())
        tiler.make_levels(TexturedModel.of(atlas, texture))
        add("tileset.json", json_text(tiler.tileset()).encode())
    return path


class _Tiler:
    """Cuts the levels, the finest first, into tiles. add: of the archive. scratch: a file to write to."""

    def __init__(
        self, up_axis: str, most: int, add: Callable[[str, bytes], None], scratch: Path, monitor: Monitor
    ) -> None:
        self.levels = list[Level]()
        self.monitor = monitor
        self.up_axis, self.most, self.add, self.scratch = up_axis, most, add, scratch
        self.to_tileset = tileset_axes(up_axis)
        self.written = 0

    def make_levels(self, full: TexturedModel) -> None:
        """Until one fits in a tile, or is hardly smaller than the one before."""
        self.levels = [Level(full, torch.zeros(full.faces))]
        while not self._fits(before := self.levels[-1]):
            faces = max(before.model.faces // QUARTER, LEAST_FACES)
            model = smaller(before.model, faces, 1 / QUARTER, MAX_SIDE, Monitor()).model
            self.levels.append(Level(model, distance_of_faces(model, full)))
            if float(self.levels[-1].weight.sum()) > LEAST_SHRINKING * float(before.weight.sum()):
                break

    def _fits(self, level: Level) -> bool:
        if float(level.weight.sum()) > SURELY * self.most:
            return False
        return len(self._encoded(level, torch.arange(level.model.faces))) <= self.most

    def tileset(self) -> dict[str, Any]:
        """The tileset.json, once its tiles are added."""
        whole = Cell(0, tuple(torch.arange(level.model.faces) for level in self.levels))
        tiles = self._tiles(len(self.levels) - 1, whole)
        box = np.concatenate([corners_of(tile) for tile in tiles])
        size = float(np.linalg.norm(np.ptp(box, axis=0)))
        root = tiles[0] if len(tiles) == 1 else {**_box(box), "geometricError": size, "children": tiles}
        return {"asset": {"version": "1.1"}, "geometricError": size, "root": {**root, "refine": "REPLACE"}}

    def _tiles(self, number: int, cell: Cell) -> list[Tile]:
        """Tiles of a level that together are what it has in a cell, with all that replaces them."""
        faces, level = cell.faces[number], self.levels[number]
        if len(faces) == 0:
            return self._below(number, cell)
        data = self._encoded(level, faces)
        if len(data) > self.most and (halves := cell.halves(self.levels)):
            return [tile for half in halves for tile in self._tiles(number, half)]
        for quality in QUALITIES:
            if len(data) > self.most:
                data = self._encoded(level, faces, quality)
        name = f"{len(self.levels) - 1 - number}/{self.written}.glb"
        self.written += 1
        self.add(name, data)
        below = self._below(number, cell)
        points = level.mesh.v_pos[level.mesh.t_pos_idx[faces]].double().view(-1, 3).numpy() @ self.to_tileset.T
        errors = [level.error_of(faces) if number else 0.0, *(tile["geometricError"] for tile in below)]
        volume = _box(np.concatenate([points, *map(corners_of, below)]))
        tile = {**volume, "geometricError": max(errors), "content": {"uri": name}}
        return [tile | ({"children": below} if below else {})]

    def _below(self, number: int, cell: Cell) -> list[Tile]:
        """The tiles of the next finer level, whose cells are quarters of those that are not cut further."""
        if number == 0:
            return []
        depth = 2 * (len(self.levels) - number)
        return [tile for part in cell.parts(depth, self.levels) for tile in self._tiles(number - 1, part)]

    def _encoded(self, level: Level, faces: Tensor, quality: int = JPEG_QUALITY) -> bytes:
        if self.monitor.stop_requested():
            raise Stopped("stopped while tiles were made; resume makes all of them again")
        write_pages(self.scratch, [cut_out(level.model, faces)], level.normals, self.up_axis, quality)
        return self.scratch.read_bytes()


def tileset_axes(up_axis: str) -> NDArray[np.float64]:
    """[3,3] from the scan's world to the tileset's frame: the node's rotation to +y up, then the viewer's to +z up."""
    x, y, z, w = TO_Y_UP[up_axis]
    to_y_up = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    to_z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    axes: NDArray[np.float64] = to_z_up @ to_y_up.round()  # by quarters of a turn
    return axes


def _box(points: NDArray[np.float64]) -> Tile:
    """The axis-parallel box about points [N,3] of the tileset's frame: its center and its three half axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) / 2, THINNEST)
    return {"boundingVolume": {"box": [*((low + high) / 2).tolist(), *np.diag(half).reshape(-1).tolist()]}}


def corners_of(tile: Tile) -> NDArray[np.float64]:
    """The lowest and the highest corner [2,3] of a tile's box."""
    box = np.array(tile["boundingVolume"]["box"])
    half = box[[3, 7, 11]]
    return np.stack([box[:3] - half, box[:3] + half])
