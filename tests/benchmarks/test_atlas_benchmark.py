"""The atlas benchmark at its smallest."""

from __future__ import annotations

import atlas
import torch


def test_meshes_have_about_as_many_faces_as_asked_for_and_an_atlas() -> None:
    sheet = atlas.sheet_with_boxes(2_000)
    finer = atlas.refined(sheet, 10_000)
    assert len(sheet.t_pos_idx) == 1922
    assert len(finer.t_pos_idx) == 4 * 1922
    assert torch.unique(finer.t_pos_idx).numel() == len(finer.v_pos)
    name, faces, charts, seconds, *_ = atlas.row("sheet", sheet)
    assert (name, faces) == ("sheet", 1922)
    assert int(charts) > 1
    assert float(seconds) > 0
