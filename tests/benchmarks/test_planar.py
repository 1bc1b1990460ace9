"""The 2D case holds its bars: sharp with auxiliary views, not without (the negative control)."""

from __future__ import annotations

from pathlib import Path

import planar
import pytest

SIZE, SHIFT, STEPS = 96, 6, 1200


@pytest.mark.slow
def test_auxiliary_views_make_the_texture_sharp() -> None:
    """At most 0.45 of the L1 optimum's distance to the truth's patches."""
    assert planar.ratio(SIZE, SHIFT, STEPS, auxiliary=True) <= 0.45


@pytest.mark.slow
def test_without_auxiliary_views_it_does_not_become_sharp() -> None:
    assert planar.ratio(SIZE, SHIFT, STEPS, auxiliary=False) > 0.85


def test_a_run_is_reported_and_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = ["--size", "48", "--shift", "2", "--steps", "4", "--device", "cpu", "--results", str(tmp_path)]
    planar.main(line)
    report = (tmp_path / "planar.md").read_text()
    rows = [row.split("|")[1:-1] for row in report.splitlines() if row.startswith("| drawn")]
    assert [row[3].strip() for row in rows] == ["-", *[f"{step} of 4" for step in (1, 2, 3, 4)] * 2]
    assert rows[0][-1].strip() == "1.000"
    assert (tmp_path / "planar.png").exists()
    monkeypatch.setattr(planar, "optimize", lambda *_, **__: pytest.fail("it was run already"))
    planar.main(line)


def test_a_picture_fills_the_largest_case() -> None:
    assert planar.drawn_picture(544).shape == (544, 544, 3)


def test_a_photograph_that_is_too_small_is_refused(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "small.png"), planar.drawn_picture(40).numpy())
    assert planar.cut(tmp_path / "small.png", 40).shape == (40, 40, 3)
    assert planar.cut(tmp_path / "small.png", 20).shape == (20, 20, 3)
    with pytest.raises(SystemExit, match="fewer than 41 pixels"):
        planar.cut(tmp_path / "small.png", 41)
