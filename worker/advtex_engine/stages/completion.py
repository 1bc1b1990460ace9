"""The texture where no photograph shows the surface, and the model without what is not wanted of that."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from advtex_engine.core.config import TextureConfig
from advtex_engine.core.scene import Atlas
from advtex_engine.coverage import Completed, complete_texture
from advtex_engine.mesh.faces import keep_faces


def completed_model(
    atlas: Atlas, texture: Tensor, seen: Tensor, made_up_faces: int, config: TextureConfig
) -> tuple[Atlas, Completed]:
    """The texture on all of the surface, and the atlas without faces that `config.unseen` removes.

    seen: [H,W] bool, texels that photographs show. made_up_faces: so many of the last faces close holes.
    """
    faces = len(atlas.mesh.t_pos_idx)
    made_up = torch.arange(faces, device=seen.device) >= faces - made_up_faces
    completed = complete_texture(atlas, texture, seen, made_up=made_up, gray=config.unseen == "gray")
    if config.unseen == "remove" and bool(completed.faces.any()):
        atlas = replace(atlas, mesh=keep_faces(atlas.mesh, completed.faces))
    return atlas, completed
