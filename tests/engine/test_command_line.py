"""The engine's command line: quick to start, exit codes, and refusals in one sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from advtex_engine.__main__ import main


def test_help_does_not_load_torch() -> None:
    code = (
        "import sys; from advtex_engine.__main__ import main; code = main(['texture', '--help']);"
        "sys.exit(code or 'torch' in sys.modules or 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--max-views N" in done.stdout


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--steps", "0"], "steps 0 is out of bounds; give 1 to 1000000, or leave it out (the method's)"),
        (["--size", "8x8"], "size 8x8 is out of bounds; give 64 to 4096 pixels a side"),
        (["--size", "big"], "size 'big' is no size; give it as WIDTHxHEIGHT"),
        (["--preset", "best"], "preset 'best' is unknown; choose one of auto, paper"),
        (["--layout", "magic"], "layout 'magic' is unknown; choose one of native"),
        (["--steps", "many"], "--steps"),
        (["--stpes", "3"], "--stpes"),
    ],
)
def test_usage_is_2_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], words: str) -> None:
    assert main(["texture", str(tmp_path), "-o", str(tmp_path / "out"), *flags]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("flags", [("--scene", "room"), ("--sensor", "lidar")])
def test_what_only_real_scans_have_is_refused_for_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, str]
) -> None:
    assert main(["synthesize", str(tmp_path / "scan"), *flags]) == 2
    assert "give --real too" in capsys.readouterr().err
    assert not (tmp_path / "scan").exists()


def test_what_cannot_be_read_is_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "none")]) == 1
    assert "none" in capsys.readouterr().err


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("advtex-engine ")
