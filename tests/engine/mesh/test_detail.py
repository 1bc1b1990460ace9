"""What decimation takes is told apart: shape that is worth a normal map, and noise that is not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.clean import decimate
from advtex_engine.mesh.detail import find_detail


def panel(noise: float, relief: float, cells: int = 100, everywhere: bool = False) -> Mesh:
    """A square metre facing +z, with waves of `relief` metres on a quarter of it or everywhere, and noise (metres)."""
    y, x = np.mgrid[: cells + 1, : cells + 1] / cells
    random = np.random.default_rng(4)
    waves = relief * np.sin(50 * x) * np.sin(40 * y)
    shape = waves if everywhere else np.where((x > 0.5) & (y > 0.5), waves, 0)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    points = np.stack((x, y, shape + noise * random.standard_normal(x.shape)), -1).reshape(-1, 3)
    return Mesh(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(faces))


@pytest.mark.parametrize(
    ("noise", "relief", "everywhere", "why"),
    [
        (0.0, 0.01, False, "decimation took shape"),
        (0.0001, 0.01, False, "decimation took shape"),
        (0.0015, 0.01, False, "carve the noise"),
        (0.0015, 0.0, False, "carve the noise"),
        (0.0, 0.01, True, "carve the noise"),  # as strong all over: it cannot be told from noise
        (0.0, 0.0001, False, "hardly changed"),
    ],
)
def test_a_map_is_worth_it_for_shape_and_not_for_noise(noise: float, relief: float, everywhere: bool, why: str) -> None:
    fine = panel(noise, relief, everywhere=everywhere)
    coarse = decimate(fine, 2_000, Monitor())
    detail, report = find_detail(fine, coarse)
    assert why in report["why"], report
    assert report["made"] == (detail is not None) == ("shape" in why)
    assert report["faces"] == 20_000
    if detail is not None:
        assert detail.v_pos is coarse.v_pos
        assert 1e-5 < detail.error < 0.01


def test_the_noise_is_that_of_the_flat_surface() -> None:
    """Normals of a regular grid with heights of deviation s are off by s / cell * sqrt(2 / 3), by their six faces."""
    fine = panel(0.001, 0.0)
    _, report = find_detail(fine, decimate(fine, 2_000, Monitor()))
    assert report["noise_degrees"] == pytest.approx(np.degrees(0.001 / 0.01 * (2 / 3) ** 0.5), rel=0.35)


def test_without_decimation_there_is_nothing_to_tell() -> None:
    mesh = panel(0.001, 0.01, cells=10)
    assert find_detail(mesh, mesh) == (None, {"made": False, "why": "the mesh was not decimated"})
