"""A scan's mesh is parsed once on its way through the engine, by whatever door it comes in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_scan import write_scan

import advtex_scan.mesh
from advtex_engine.__main__ import main
from advtex_engine.conventions.check import deep_check
from advtex_engine.core.config import TextureConfig
from advtex_engine.core.monitor import Monitor
from advtex_engine.ingest.read import ingest
from advtex_scan.mesh import Arithmetic, MeshSource, MeshSurface


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each mesh of a scan was parsed."""
    counts, parse = Counter[str](), advtex_scan.mesh.parse_mesh

    def counted(source: MeshSource, arithmetic: Arithmetic) -> MeshSurface:
        counts[source.path] += 1
        return parse(source, arithmetic)

    monkeypatch.setattr(advtex_scan.mesh, "parse_mesh", counted)
    return counts


def texture(scan: Path) -> None:
    result = str(scan.parent / "result")
    assert main(["texture", str(scan), "-o", result, "--method", "mean", "--size", "96x72", "--device", "cpu"]) == 0


def read(scan: Path) -> None:
    ingest(scan, TextureConfig(), Monitor())


@pytest.mark.parametrize("door", [deep_check, read, texture])
def test_a_scans_mesh_is_parsed_once(tmp_path: Path, parsed: Counter[str], door: Callable[[Path], object]) -> None:
    door(write_scan(tmp_path / "scan"))
    assert parsed == {"mesh.ply": 1}


def test_for_an_evaluation_too(tmp_path: Path, parsed: Counter[str], capsys: pytest.CaptureFixture[str]) -> None:
    scan = write_scan(tmp_path / "scan")
    texture(scan)
    parsed.clear()
    assert main(["evaluate", str(tmp_path / "result" / "model.obj"), str(scan)]) == 0
    assert parsed == {"mesh.ply": 1}
