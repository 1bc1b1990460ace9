"""The textured model as a camera sees it: needs torch alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.cameras import scaled_camera
from advtex_engine.core.scene import Atlas, Camera
from advtex_engine.render.rasterize import rasterize
from advtex_engine.render.texture import sample_image

BACKGROUND = 0.8
"""Gray level of pixels that show no surface."""
RENDER_BYTES, BYTES_PER_SAMPLE = 1 << 30, 100
"""What pictures take that are rendered at once; 97 bytes were seen."""


def render_view(
    atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2, background: float = BACKGROUND
) -> Tensor:
    """The textured model as `camera` sees it: [H,W,3] float32 sRGB in [0,1]. Not differentiable.

    texture: [atlas.height,atlas.width,3] uint8 sRGB or float in [0,1]; sampled bilinearly at supersample x supersample
    points per pixel, whose sRGB values are averaged.
    """
    assert texture.shape == (atlas.height, atlas.width, 3)
    return shade(gbuffer(atlas, camera, supersample), texture, background)


def render_layers(atlas: Atlas, texture: Tensor, camera: Camera, *, supersample: int = 2) -> tuple[Tensor, Tensor]:
    """Color [H,W,3] times coverage, and coverage [H,W], both float32 in [0,1]: what `render_view` puts together."""
    assert texture.shape == (atlas.height, atlas.width, 3)
    return shade_layers(gbuffer(atlas, camera, supersample), texture)


@dataclass(frozen=True)
class GBuffer:
    """Where a camera's samples meet the model; renders of several textures share it.

    hit: [P] int64, which of the H * s x W * s samples do, in the order of rows. uv: [P,2] float32, where they do.
    width, height: of the picture. supersample: s.
    """

    hit: Tensor
    uv: Tensor
    width: int
    height: int
    supersample: int

    @property
    def coverage(self) -> float:
        """Share of the picture that shows the model."""
        return len(self.hit) / (self.width * self.height * self.supersample**2)


def gbuffer(atlas: Atlas, camera: Camera, supersample: int = 2) -> GBuffer:
    """What `camera` sees of the model at supersample x supersample points per pixel."""
    assert supersample >= 1
    mesh = atlas.mesh
    assert mesh.v_uv is not None
    assert mesh.t_uv_idx is not None
    fine = scaled_camera(camera, camera.width * supersample, camera.height * supersample)
    fragments = rasterize(mesh, fine)
    faces = fragments.face_index.flatten()
    hit = (faces >= 0).nonzero()[:, 0]
    corners = mesh.t_uv_idx.index_select(0, faces.index_select(0, hit))
    weights = fragments.barycentric.view(-1, 3).index_select(0, hit)
    # The mean of three corners weighted by the barycentrics.
    uv = F.embedding_bag(corners, mesh.v_uv, per_sample_weights=weights, mode="sum")
    return GBuffer(hit, uv, camera.width, camera.height, supersample)


def renders_at_once(cameras: Sequence[Camera], threads: int, supersample: int = 2) -> int:
    """How many of them may be looked through at once, in as many threads, without taking more than RENDER_BYTES."""
    pixels = max((camera.width * camera.height for camera in cameras), default=1)
    return max(1, min(threads, RENDER_BYTES // (BYTES_PER_SAMPLE * supersample**2 * pixels)))


def shade(buffer: GBuffer, texture: Tensor, background: float = BACKGROUND) -> Tensor:
    """The picture [H,W,3] of `render_view`; the texture [h,w,3] may have any size."""
    color, coverage = shade_layers(buffer, texture)
    return color + background * (1 - coverage[..., None])


def shade_layers(buffer: GBuffer, texture: Tensor) -> tuple[Tensor, Tensor]:
    """The two layers of `render_layers`; the texture [h,w,3] may have any size."""
    texels = texture.to(torch.float32)
    height, width, _ = texels.shape
    sampled = sample_image(texels, buffer.uv * buffer.uv.new_tensor([width, height]))
    if texture.dtype == torch.uint8:
        sampled /= 255
    fine = sampled.new_zeros((buffer.height * buffer.width * buffer.supersample**2, 4))
    fine.index_copy_(0, buffer.hit, F.pad(sampled, (0, 1), value=1.0))
    # Rows first, then columns: avg_pool2d takes three times as long on a CPU.
    rows = fine.view(buffer.height, buffer.supersample, buffer.width, buffer.supersample, 4).unbind(1)
    columns = sum(rows[1:], rows[0]).unbind(2)
    pooled = sum(columns[1:], columns[0])
    if buffer.supersample > 1:
        pooled = pooled / buffer.supersample**2
    return pooled[..., :3], pooled[..., 3]
