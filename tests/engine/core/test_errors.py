"""What an error of a scan says."""

from __future__ import annotations

from advtex_engine.core.errors import Problem, ScanError


def test_problems_that_differ_in_their_places_alone_are_told_once() -> None:
    broken = [Problem("bad_image", f"color/{number}.png", "cannot be decoded", "leave it out") for number in range(240)]
    other = Problem("no_mesh", "mesh.ply", "is empty", "scan again")
    error = ScanError(broken[0], other, *broken[1:])
    places = "color/0.png, color/1.png, color/2.png and 237 more"
    assert str(error) == f"{places}: cannot be decoded (leave it out); mesh.ply: is empty (scan again)"
    assert len(error.problems) == 241
