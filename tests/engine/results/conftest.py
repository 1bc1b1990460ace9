"""The validators of npm, for the files of results."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

VALIDATOR = Path(__file__).parents[1] / "gltf_validator"


@pytest.fixture(scope="session")
def gltf_report(request: pytest.FixtureRequest) -> Callable[[Path], dict[str, Any]]:
    """What the Khronos validator says of a GLB; it is installed in pytest's cache."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed: it provides the Khronos glTF validator")
    assert request.config.cache is not None
    folder = Path(request.config.cache.mkdir("gltf_validator"))
    for name in ("package.json", "validate.cjs"):
        shutil.copy(VALIDATOR / name, folder)
    if not (folder / "node_modules" / "gltf-validator").is_dir():
        command = [npm, "install", "--no-save", "--no-audit", "--no-fund", "--ignore-scripts"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=240)

    def report(model: Path) -> dict[str, Any]:
        command = ["node", "validate.cjs", str(model)]
        run = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=120)
        found: dict[str, Any] = json.loads(run.stdout)
        return found

    return report
