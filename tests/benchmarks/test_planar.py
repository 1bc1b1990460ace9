"""The 2D case holds its bars: sharp with auxiliary views, not without (the negative control)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

STEPS = 2000


@pytest.fixture(scope="module")
def planar() -> ModuleType:
    spec = importlib.util.spec_from_file_location("planar_benchmark", Path(__file__).with_name("planar.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_auxiliary_views_make_the_texture_sharp(planar: ModuleType) -> None:
    """At most 0.45 of the L1 optimum's distance to the truth's patches."""
    assert planar.ratio(planar.drawn_picture(), STEPS, auxiliary=True) <= 0.45


@pytest.mark.slow
def test_without_auxiliary_views_it_does_not_become_sharp(planar: ModuleType) -> None:
    assert planar.ratio(planar.drawn_picture(), STEPS, auxiliary=False) > 0.85
