"""Helpers of the tests are imported by name alone, from two folders: whoever comes first would hide the other's."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parents[1]


def test_helpers_and_benchmarks_have_no_name_in_common() -> None:
    benchmarks, helpers = ({path.stem for path in (TESTS / room).glob("*.py")} for room in ("benchmarks", "support"))
    assert {"fleet", "harness"} <= benchmarks
    assert {"live_fleet", "chaos"} <= helpers
    assert not benchmarks & helpers
