"""The fusion benchmark at its smallest, and what it must show on the sample scan."""

from __future__ import annotations

import fusion
import pytest
import torch

from advtex_engine.core.monitor import Monitor
from advtex_engine.mesh.fusion import fuse


@pytest.mark.slow
def test_a_corner_of_the_room_is_fused_in_place() -> None:
    frames, room = fusion.of_room(3)
    name, count, voxel_mm, _, faces, to_room, _, seconds, megabytes = fusion.row("room", frames, room)
    assert (name, count) == ("room", 3)
    assert float(str(to_room).split()[0]) < float(voxel_mm)
    assert int(faces) > 10_000
    assert float(seconds) > 0
    assert 100 < int(megabytes) < 3_000


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.skipif(not (fusion.DATA / "scans").is_dir(), reason=f"no sample scans at {fusion.DATA}")
def test_the_kitchen_fused_from_its_own_depth_lies_on_its_mesh() -> None:
    frames, given = fusion.of_scan(fusion.DATA / "scans" / "apt0_kitchen", (320, 240))
    fused, _ = fuse(fusion.thinned(frames, 24), torch.device("cpu"), Monitor())
    to_given, to_fused = fusion.apart(fused, given, points=500)
    assert float(to_given.median()) < 0.010
    assert float(to_fused.median()) < 0.010
