"""What decimation took of the mesh, kept in the work folder until the export bakes it into a normal map."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from advtex_engine.atlas import MeshPreparation
from advtex_engine.core.scene import Atlas, Mesh
from advtex_engine.mesh.detail import Detail
from advtex_engine.results.normal_map import bake_normals
from advtex_engine.runtime.checkpoint import WorkFolder

NAME, CONTENT = "detail", ("fine_v_pos", "fine_t_pos_idx", "v_pos", "error")


def keep_detail(preparation: MeshPreparation, folder: WorkFolder) -> dict[str, Any]:
    """Saves the mesh before decimation where a normal map is worth it: nothing needs it before the export.

    -> the report about it.
    """
    detail, report = preparation.detail()
    if detail is not None:
        fine = detail.fine
        content = {"fine_v_pos": fine.v_pos, "fine_t_pos_idx": fine.t_pos_idx.int(), "v_pos": detail.v_pos}
        folder.save(NAME, content | {"error": detail.error})
    return report


def has_detail(report: dict[str, Any], folder: WorkFolder) -> bool:
    """Whether the folder holds what the report promises a normal map of."""
    return not report["made"] or folder.load(NAME, CONTENT, mapped=True) is not None


def baked_normals(atlas: Atlas, report: dict[str, Any], folder: WorkFolder) -> Tensor | None:
    """The normal map, None without one. atlas: of all faces, before any is left out. The report learns its size."""
    if not report["made"]:
        return None
    saved = folder.load(NAME, CONTENT)
    assert saved is not None
    fine = Mesh(saved["fine_v_pos"], saved["fine_t_pos_idx"].long())
    baked = bake_normals(Detail(fine, saved["v_pos"], saved["error"]), atlas)
    report |= {"width": baked.shape[1], "height": baked.shape[0]}
    return baked
