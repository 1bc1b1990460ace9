"""Choices of the other scans, on scores that one can work out by hand."""

from __future__ import annotations

import json
from pathlib import Path

import harness
import pytest
from leave_one_out import Choice, leave_one_out, main

KITCHENS = {
    "near": {"0.5": 0.20, "1": 0.18, "2": 0.10},
    "far": {"0.5": 0.20, "1": 0.19, "2": 0.25},
    "bin": {"0.5": 0.20, "1": 0.18, "2": 0.24},
}


def test_each_scan_gets_what_the_others_choose() -> None:
    """`near` alone is for 2, by so much that whoever is chosen for together with it gets 2."""
    assert leave_one_out(KITCHENS, "0.5") == [
        Choice("near", "1", pytest.approx(0.1)),
        Choice("far", "2", pytest.approx(-0.25)),
        Choice("bin", "2", pytest.approx(-0.2)),
    ]


def test_large_scores_do_not_outvote_small_ones() -> None:
    scores = {"a": {"now": 1.0, "new": 1.05}, "b": {"now": 0.1, "new": 0.08}, "c": {"now": 0.5, "new": 0.4}}
    assert [choice.value for choice in leave_one_out(scores, "now")] == ["new", "new", "new"]


def test_equal_values_change_nothing() -> None:
    same = {"new": 0.2, "now": 0.2}
    assert leave_one_out({"a": same, "b": same}, "now") == [Choice("a", "now", 0.0), Choice("b", "now", 0.0)]


def test_scans_must_have_all_values() -> None:
    with pytest.raises(ValueError, match="b has no score for 2;"):
        leave_one_out({"a": {"1": 0.2, "2": 0.1}, "b": {"1": 0.2}}, "1")
    with pytest.raises(ValueError, match="1 scans: at least 2"):
        leave_one_out({"a": {"1": 0.2}}, "1")


def results(path: Path) -> Path:
    file = harness.Results(path / "parts.json")
    for scan, row in KITCHENS.items():
        for value, score in row.items():
            file.add({"scan": scan, "reach": float(value), "size": "640x480"}, {"lpips_corrected": score}, 1.0)
    file.add({"synthetic": "default", "reach": 1.0}, {"lpips": 0.1}, 1.0)
    return file.path


def test_the_command_reads_the_cells_of_a_benchmark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = results(tmp_path)
    capsys.readouterr()
    main([str(path), "--vary", "reach", "--now", "0.5"])
    printed = capsys.readouterr().out
    assert "| far | 2.0 | 0.200 | 0.250 | -25.00 % |" in printed
    assert "did not choose: -11.67 %." in printed
    assert "Worst: -25.00 %, far. It stays out" in printed
    assert "All scans together choose 2.0." in printed
    main([str(path), "--vary", "reach", "--now", "0.5", "--values", "1.0"])
    printed = capsys.readouterr().out
    assert "did not choose: +8.33 %." in printed
    assert "stays out" not in printed


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    path = results(tmp_path)
    harness.Results(path).add({"scan": "bin", "reach": 1.0, "size": "320x240"}, {"lpips_corrected": 0.1}, 1.0)
    line = [str(path), "--vary", "reach", "--now", "0.5"]
    with pytest.raises(SystemExit, match=r"bin, 1.0: there are several cells"):
        main(line)
    main([*line, "--where", "size=640x480"])
    path.write_text(json.dumps({"cells": []}))
    with pytest.raises(SystemExit, match="0 scans: at least 2"):
        main(line)
