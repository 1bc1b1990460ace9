"""Drawing the mesh and sampling the texture: view maps, pairs of views, pictures of the model."""

from advtex_engine.render.texture import fill_holes

__all__ = ["fill_holes"]
