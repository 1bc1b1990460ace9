"""The conditional PatchGAN discriminator (paper section 3.2, supplement figure "details")."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

RECEPTIVE_FIELD = 70
PATCH_STRIDE = 8
PATCH_OFFSET = -23  # the receptive field of logit (0, 0) starts this far outside the image
STRIDES = (2, 2, 2, 1, 1)
MIN_SIZE = 24  # pixels per side that give one logit


class PatchDiscriminator(nn.Module):
    """Five 4x4 convolutions with padding 1: 6->64 s2, 64->128 s2, 128->128 s2, 128->128 s1, 128->1 s1.

    Leaky ReLU 0.2 between them, no normalization, weights N(0, 0.02), biases zero: 664,001 parameters. Returns logits;
    the paper's sigmoid is folded into the losses (softplus on logits is its stable equal).
    """

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        channels = (6, 64, 128, 128, 128, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv2d(channels[i], channels[i + 1], 4, stride, padding=1) for i, stride in enumerate(STRIDES)
        )
        for layer in self.convolutions:
            assert isinstance(layer, nn.Conv2d) and layer.bias is not None
            nn.init.normal_(layer.weight, 0.0, 0.02, generator=generator)
            nn.init.zeros_(layer.bias)
            # As the images are: so gradients come as Adam needs them.
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)

    def forward(self, condition: Tensor, residual: Tensor) -> Tensor:
        """condition I_A [B,3,H,W] and residual X - I_A [B,3,H,W] -> logits [B,1,H//8-2,W//8-2], one per 70x70 patch."""
        assert condition.shape == residual.shape and condition.shape[1] == 3
        return self.examine(torch.cat((condition, residual), 1))[0]

    def examine(self, x: Tensor, parameters: Sequence[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        """The logits as from `forward`, and what the four layers before them respond: [B,64|128,h,w] each.

        x: [B,6,H,W], condition and residual; channels beyond them are met by weights of zero. parameters: to be taken
        in place of the own ones, in their order; their type is that of the arithmetic.
        """
        assert min(x.shape[-2:]) >= MIN_SIZE
        given = list(self.parameters() if parameters is None else parameters)
        x = x.to(given[0].dtype).contiguous(memory_format=torch.channels_last)
        # Tensor cores want a multiple of 8 channels; the parameters stay those of 6.
        if x.shape[1] > 6:
            given[0] = F.pad(given[0], (0, 0, 0, 0, 0, x.shape[1] - 6))
        features = []
        for weight, bias, stride in zip(given[:-2:2], given[1:-2:2], STRIDES[:-1], strict=True):
            x = F.leaky_relu(F.conv2d(x, weight, bias, stride, padding=1), 0.2, inplace=True)
            features.append(x)
        return F.conv2d(x, given[-2], given[-1], STRIDES[-1], padding=1), features


def patch_shares(mask: Tensor) -> Tensor:
    """Share of each patch's receptive field, inside the image, that a mask [B,1,H,W] covers -> [B,1,H//8-2,W//8-2]."""
    # Rows, then columns: 140 additions per patch and not 4,900.
    padding = -PATCH_OFFSET
    rows = F.avg_pool2d(
        mask.to(torch.float32), (RECEPTIVE_FIELD, 1), (PATCH_STRIDE, 1), (padding, 0), count_include_pad=False
    )
    return F.avg_pool2d(rows, (1, RECEPTIVE_FIELD), (1, PATCH_STRIDE), (0, padding), count_include_pad=False)
