"""Exposure of each frame: gain and offset per channel that make the photographs agree on the surface.

Corrected color = gain * color + offset, in sRGB values of [0, 1] (a camera's exposure is nearly a gain there too).
What all frames share cannot be known: the gains' geometric mean and the offsets' mean stay 1 and 0, so nothing as a
whole turns gray or dark. The same holds for places: a camera that adapts to what it sees brightens dark corners, and
each place keeps on average the colors that it was photographed with. What goes is what neighboring frames disagree on.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.refine.points import Observations
from advtex_engine.refine.solve import Anchor, residuals, solve_views

DARK, BRIGHT = 0.02, 0.96  # values beyond are clipped and say nothing about exposure
ROBUST_SCALE = 0.05  # residual at which an observation loses half of its weight
GAIN_PRIOR, OFFSET_PRIOR = 0.003, 0.1  # of the number of observations: towards 1 and 0
ANCHOR = 0.5  # pull of each place's mean color towards that of the photographs as they are, relative to the evidence
ROUNDS = 4
GAIN_RANGE = (0.5, 2.0)
OFFSET_RANGE = (-0.1, 0.1)
FADE = 0.88  # the correction fades out from here to 1, so that clipped highlights stay what they are


def fit_exposure(color: Tensor, valid: Tensor, points: Observations) -> tuple[Tensor, Tensor]:
    """Gain and offset, [V,3] float32 each.

    color: [V,K,3] in [0,1], what the views see at their points. valid: [V,K] bool.
    """
    clear = valid & ((color > DARK) & (color < BRIGHT)).all(-1)
    count = clear.sum(1, keepdim=True).to(color.dtype)
    prior = torch.cat((GAIN_PRIOR * count, OFFSET_PRIOR * count), 1) + 1e-6
    gains, offsets = [], []
    for channel in color.unbind(-1):
        jacobian = torch.stack((channel, torch.ones_like(channel)), 1)
        change = torch.zeros((len(channel), 2), dtype=channel.dtype, device=channel.device)
        anchor = Anchor((jacobian,), ANCHOR * clear.to(channel.dtype), points)
        for _ in range(ROUNDS):
            corrected = channel + (change[:, None] @ jacobian)[:, 0]
            residual, weight = residuals(corrected, clear, points, ROBUST_SCALE)
            change = change + solve_views(jacobian, residual, weight, points, prior, change, anchor)
        gain, offset = (1 + change[:, 0]).clamp(*GAIN_RANGE), change[:, 1]
        share = count[:, 0] / count.sum().clamp(min=1)
        common = (gain.log() * share).sum().exp()
        # Dividing by the common gain divides the offsets too.
        offset = offset / common
        gains.append((gain / common).clamp(*GAIN_RANGE))
        offsets.append((offset - (offset * share).sum()).clamp(*OFFSET_RANGE))
    return torch.stack(gains, 1), torch.stack(offsets, 1)


def corrected_color(color: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """Colors [...,3] in [0,1] with gain and offset [...,3] applied; unchanged where they are clipped at 1."""
    share = ((1 - color) / (1 - FADE)).clamp(0, 1)
    return (color + share * ((gain - 1) * color + offset)).clamp(0, 1)


def sample_colors(color: Tensor, uv: Tensor) -> Tensor:
    """Colors [V,K,3] of images [V,3,h,w] at pixel positions uv [V,K,2], averaged over about four pixels."""
    size = uv.new_tensor((color.shape[3], color.shape[2]))
    half = F.avg_pool2d(color, 2, ceil_mode=True, count_include_pad=False)
    grid = (2 * uv / size - 1)[:, :, None]
    return F.grid_sample(half, grid, padding_mode="border", align_corners=False)[..., 0].mT
