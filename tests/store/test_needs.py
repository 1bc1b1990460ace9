"""What jobs are said to need: the classes of workers stand on it."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from advtex_contract.options import JobOptions, Preset
from advtex_store.needs import BASE, GIB, needed_memory

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
    if grown in ("views", "width"):
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


def test_a_usual_scan_fits_a_usual_machine() -> None:
    """200 views of a usual size on 8 GiB, 1,000 of a large one on a GPU of 24 GiB."""
    assert needed_memory(JobOptions(), 200, 640, 480) < 8 * GIB
    assert needed_memory(JobOptions(max_texture_size=4096), 1000, 1296, 968) < 24 * GIB
