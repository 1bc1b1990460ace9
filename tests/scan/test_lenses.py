"""Distortion that can be undone, and such that cannot."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from advtex_scan import check_scan
from advtex_scan._lenses import distortion_problem
from advtex_scan.layouts.tum import CAMERAS
from advtex_scan.manifest import Distortion, Intrinsics


def camera(distortion: Distortion | None, fx: float = 500.0) -> Intrinsics:
    return Intrinsics(fx, 500.0, 320.0, 240.0, 640, 480, distortion)


@pytest.mark.parametrize(
    "distortion",
    [None, Distortion(), Distortion(-0.28, 0.08), Distortion(0.1, -0.02, 0.001, 0.002), Distortion(k1=5.0)],
)
def test_lenses_as_they_are(distortion):
    assert distortion_problem(camera(distortion)) is None


@pytest.mark.parametrize("name", CAMERAS)
def test_published_cameras_can_be_undistorted(name):
    assert distortion_problem(CAMERAS[name].intrinsics()) is None


@pytest.mark.parametrize(
    ("distortion", "message"),
    [
        (Distortion(k1=-0.6), "folds the image"),
        (Distortion(k1=-5.0), "folds the image"),
        (Distortion(k1=0.1, k3=-3.0), "folds the image"),
        (Distortion(k1=math.nan), "is that of no lens"),
        (Distortion(k2=math.inf), "is that of no lens"),
        (Distortion(p1=50.0), "is that of no lens"),
    ],
)
def test_lenses_that_are_none(distortion, message):
    assert message in (distortion_problem(camera(distortion)) or "")


@given(*[st.floats() for _ in range(5)], st.floats(1e-300, 1e300))
def test_any_coefficients_get_an_answer(k1, k2, p1, p2, k3, fx):
    problem = distortion_problem(camera(Distortion(k1, k2, p1, p2, k3), fx))
    assert problem is None or problem.startswith("its distortion")


def test_a_scan_with_such_a_lens_is_told_so(maker):
    maker.native()
    maker.scan["color_intrinsics"] |= {"k1": -9.0}
    report = check_scan(maker.folder())
    errors = {finding.code: finding for finding in report.findings if finding.severity == "error"}
    assert "color/0.png" in errors["bad_distortion"].where
    assert "undistort" in errors["bad_distortion"].remedy
