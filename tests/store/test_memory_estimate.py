"""What jobs are said to need: the classes of workers stand on it."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from advtex_contract.options import JobOptions, Preset
from advtex_engine.ingest.frames import MAX_HELDOUT, MAX_MAP_BYTES
from advtex_engine.mesh.fusion import MAX_VOXEL_BYTES
from advtex_options.options import MAX_VIEWS
from advtex_store.memory_estimate import (
    BASE,
    GIB,
    MAX_FUSED,
    MAX_SCORED_VIEWS,
    MAX_VIEW_BYTES,
    PER_FUSED_FRAME,
    needed_memory,
)

presets = st.sampled_from(Preset)
views = st.integers(1, 5000)
sides = st.integers(64, 4096)
textures = st.sampled_from([256, 1024, 4096, 8192])


@given(presets, views, sides, sides, textures, st.booleans(), st.sampled_from(["views", "width", "texture", "holdout"]))
def test_more_of_anything_never_needs_less(
    preset: Preset, views: int, width: int, height: int, texture: int, holdout: bool, grown: str
) -> None:
    chosen: dict[str, Any] = {"preset": preset, "max_texture_size": texture, "holdout": 8 if holdout else None}
    before = needed_memory(JobOptions(**chosen), views, width, height)
    if grown == "texture":
        chosen["max_texture_size"] = 2 * texture
    elif grown == "holdout":
        chosen["holdout"] = 8
    after = needed_memory(
        JobOptions(**chosen), views + (grown == "views"), 2 * width if grown == "width" else width, height
    )
    assert BASE < before <= after
    if grown in ("views", "width") and views < 100 and width * height < 500_000:
        assert before < after, "each view is kept whole"


@given(presets, views, sides, sides, sides, sides)
def test_the_size_that_was_asked_for_counts_and_not_the_captured_one(
    preset: Preset, views: int, width: int, height: int, captured_width: int, captured_height: int
) -> None:
    asked = JobOptions(preset=preset, width=width, height=height)
    needed = needed_memory(asked, views, captured_width, captured_height)
    assert needed == needed_memory(JobOptions(preset=preset), views, width, height)


def test_scores_take_room() -> None:
    assert needed_memory(JobOptions(holdout=8), 50, 640, 480) > needed_memory(JobOptions(), 50, 640, 480)


def test_of_long_scans_only_chosen_views_count() -> None:
    assert MAX_HELDOUT == MAX_SCORED_VIEWS
    assert MAX_MAP_BYTES == MAX_VIEW_BYTES
    assert needed_memory(JobOptions(), 100_000, 640, 480) == needed_memory(JobOptions(), MAX_VIEWS, 640, 480)
    few = JobOptions(max_views=60)
    assert needed_memory(few, 5000, 640, 480) == needed_memory(JobOptions(), 60, 640, 480)
    assert needed_memory(JobOptions(holdout=8), 5000, 640, 480) > needed_memory(JobOptions(holdout=8), 240, 640, 480)
    assert needed_memory(JobOptions(max_views=2000), 5000, 4000, 3000) < 40 * GIB


@given(presets, views, sides, sides)
def test_a_mesh_that_is_fused_may_need_more_and_never_less(preset: Preset, views: int, width: int, height: int) -> None:
    options = JobOptions(preset=preset)
    given_mesh, fused = (needed_memory(options, views, width, height, fuses=fuses) for fuses in (False, True))
    assert given_mesh <= fused <= max(given_mesh, BASE + MAX_FUSED)
    assert fused >= BASE + min(views * PER_FUSED_FRAME, MAX_FUSED)


def test_what_is_fused_is_bounded() -> None:
    few, many = (needed_memory(JobOptions(width=64, height=64), views, 640, 480, fuses=True) for views in (62, 5000))
    assert BASE + GIB * 0.95 <= few < 2.5 * GIB
    assert many == BASE + MAX_FUSED
    # Measured: cleaning and decimating what was extracted takes five times the voxels' bytes.
    assert 5 * MAX_VOXEL_BYTES <= MAX_FUSED


def test_a_usual_scan_fits_a_usual_machine() -> None:
    """200 views of a usual size on 8 GiB, 1,000 of a large one on a GPU of 24 GiB."""
    assert needed_memory(JobOptions(), 200, 640, 480) < 8 * GIB
    assert needed_memory(JobOptions(), 200, 640, 480, fuses=True) < 8 * GIB
    assert needed_memory(JobOptions(max_texture_size=4096), 1000, 1296, 968) < 24 * GIB
