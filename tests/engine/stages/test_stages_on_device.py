"""Stages that were made faster, held against plain twins: what they give is unchanged."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from advtex_engine.bench.scene import made_scene
from advtex_engine.core.scene import Camera, Fragments
from advtex_engine.render.rasterize import rasterize, rasterize_views
from advtex_engine.render.reproject import reproject, seen_share, unproject_pixels
from advtex_engine.render.view_maps import ViewMaps, build_view_maps
from advtex_engine.runtime.files import write_atomically
from advtex_engine.runtime.threads import in_threads


@pytest.fixture(scope="module")
def maps() -> ViewMaps:
    scene, atlas = made_scene(600, 8, 64, 48)
    return build_view_maps(atlas, scene.views, scene.kind)


def test_cameras_looked_through_side_by_side_see_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, _ = made_scene(2000, 8, 96, 72)
    cameras = [view.camera for view in scene.views]
    alone = [rasterize(scene.mesh, camera) for camera in cameras]
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    seen = set[int]()

    def noting(function: Callable[[Camera], Fragments], items: Iterable[Camera], workers: int) -> Iterator[Fragments]:
        def noted(camera: Camera) -> Fragments:
            seen.add(threading.get_ident())
            return function(camera)

        return in_threads(noted, items, workers)

    monkeypatch.setattr("advtex_engine.render.rasterize.in_threads", noting)
    for one, other in zip(alone, rasterize_views(scene.mesh, cameras), strict=True):
        assert torch.equal(one.face_index, other.face_index)
        assert torch.equal(one.barycentric, other.barycentric)
        assert torch.equal(one.depth, other.depth)
    assert 1 < len(seen) <= 3
    seen.clear()
    # A picture so large that two would break the bound on memory is made alone, in the thread that asks.
    list(rasterize_views(scene.mesh, cameras, max_bytes=60 * 96 * 72))
    assert seen == {threading.get_ident()}


def test_shares_of_many_views_are_those_of_each(maps: ViewMaps) -> None:
    """The twin: the visibility that `reproject` finds for one view at a time, averaged."""
    pixels = torch.arange(0, maps.width * maps.height, 3)
    xy = torch.stack((pixels % maps.width, pixels // maps.width), 1) + 0.5
    depth = maps.depth[0, pixels].float()
    points = unproject_pixels(xy[depth > 0], depth[depth > 0], maps.intrinsics[0])
    views = torch.tensor([3, 0, 7, 1])
    relative = (maps.world_to_camera[views] @ torch.linalg.inv(maps.world_to_camera[0]))[:, :3].float()
    shares = seen_share(points, relative, maps, views, 0.03)
    for share, view, pose in zip(shares, views, relative, strict=True):
        _, visible = reproject(points, pose, maps, view, 0.03)
        assert float(share) == float(visible.float().mean())
    assert float(shares[1]) > 0.95  # the view itself sees all but its outline
    assert len(set(shares.tolist())) > 2


def test_files_written_by_many_threads_leave_the_mask_alone(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda number: write_atomically(tmp_path / str(number), b"x"), range(200)))
        assert {file.stat().st_mode & 0o777 for file in tmp_path.iterdir()} == {0o640}
    finally:
        assert os.umask(before) == 0o027
