"""The benchmark of a result's files, on files of a square that no run made."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import models
import pytest
import torch
from lpips_weights import write_weights
from tiny_scan import write_scan

from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.results.export import export_model
from advtex_engine.results.levels import write_smaller

CORNERS = torch.tensor([[-0.51, -0.51, 2], [0.51, -0.51, 2], [0.51, 0.51, 2], [-0.51, 0.51, 2]])
# A little more than the scan's: no pixel's center lies on an edge.
UP = "+z"  # of the scan
FACES = torch.tensor([[0, 2, 1], [0, 3, 2]])


def write_run(folder: Path) -> None:
    """What a run of the scan leaves: a checked square with other quarters each."""
    x, y = torch.meshgrid(torch.arange(256), torch.arange(256), indexing="xy")
    check = ((x // 16 + y // 16) % 2) * 120
    texture = torch.stack((60 + check, x // 2 + 60, y // 2 + 60), 2).to(torch.uint8)
    atlas = Atlas(Mesh(CORNERS, FACES, CORNERS[:, :2] * 0.8 + 0.5, FACES), 256, 256, "xatlas", 1)
    export_model(folder, atlas, texture, up_axis=UP, usdz=True)
    write_smaller(folder, atlas, texture, {"mobile", "lod"}, up_axis=UP)
    (folder / "model_new.xyz").write_bytes(b"123")
    stages = [{"stage": "optimization", "seconds": 9.0}, {"stage": "export", "seconds": 1.0}]
    scan = {"up_axis": UP, "views": 2, "heldout": ["1"], "width": 96, "height": 72}
    report = {"stages": stages, "scan": scan, "options": {"method": "mean"}}
    (folder / "report.json").write_text(json.dumps(report))
    made = ["model.png", "model.mtl", "model.obj", "model.glb", "model.usdz", "model_mobile.glb"]
    made += ["model_lod1.glb", "model_lod2.glb", "model_new.xyz"]
    seconds = dict.fromkeys(made, 0.5) | {models.LOSSLESS: models.lossless(folder)}
    (folder / "seconds.json").write_text(json.dumps(seconds))


def test_every_file_has_a_line_with_what_others_read_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = write_scan(tmp_path / "square")
    write_run(tmp_path / "runs" / "square")
    known = models.kind_and_purpose
    monkeypatch.setattr(models, "kind_and_purpose", lambda name: ("lod", "") if name.endswith("xyz") else known(name))
    judge = tmp_path / "judge"
    judge.write_text(
        f"#!{sys.executable}\nimport json, sys\ngiven = dict(zip(sys.argv[1::2], sys.argv[2::2]))\n"
        "views = json.load(open(given['--views'] + '/views.json'))['views']\n"
        "json.dump({'mean': {'lpips': 0.25 * len(views)}}, open(given['--json'], 'w'))\n"
    )
    judge.chmod(0o755)
    line = [str(scan), "--no-synthetic", "--runs", str(tmp_path / "runs"), "--holdout", "3", "--size", "96x72"]
    line += ["--judge", str(judge), "--lpips-weights", str(write_weights(tmp_path / "weights"))]
    models.main([*line, "--results", str(tmp_path)])
    (cell,) = json.loads((tmp_path / "models.json").read_text())["cells"]
    rows = {row["file"].strip("`"): row for row in cell["rows"]}
    assert list(rows) == [
        *("model.obj", "model.glb", "model.usdz", "model_mobile.glb", "model_lod1.glb", "model_lod2.glb"),
        *("model_new.xyz` (no reader of .xyz files)", models.LOSSLESS),
    ]
    (unread,) = (row for name, row in rows.items() if "xyz" in name)
    assert (unread["bytes"], unread["faces"], unread["LPIPS by the judge"], unread["CPU s"]) == (3, "-", "-", 0.5)
    folder = tmp_path / "runs" / "square"
    parts = ("model.obj", "model.mtl", "model.png")
    assert rows["model.obj"]["bytes"] == sum((folder / part).stat().st_size for part in parts)
    assert rows["model.obj"]["CPU s"] == 1.5
    for name, row in rows.items():
        if "xyz" not in name:
            assert (row["faces"], row["texels a side"]) == (2, "256")
            assert row["LPIPS to the OBJ"] < 0.02
            assert row["LPIPS by the judge"] == ("-" if name.endswith("usdz") else 0.25)
    assert rows["model.obj"]["LPIPS to the OBJ"] == 0
    assert rows[models.LOSSLESS]["LPIPS to the OBJ"] < 1e-5 < rows["model.glb"]["LPIPS to the OBJ"]
    page = (tmp_path / "models.md").read_text()
    assert "it the stage that writes all files 1.0 s (10.0%)" in page
    picture = cv2.imread(str(tmp_path / "square.jpg"))
    assert picture is not None
    assert picture.shape == (2 * (models.PANEL * 3 // 4 + models.CAPTION), 4 * models.PANEL, 3)
