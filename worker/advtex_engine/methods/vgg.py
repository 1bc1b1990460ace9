"""The texture of least distance in the features of a pretrained network (the paper's "VGG loss" baseline).

Feature reconstruction as in Johnson et al. 2016 ("Perceptual Losses for Real-Time Style Transfer and
Super-Resolution"), with the adversarial method's examples: the render of the source view against the auxiliary view
warped into it. A fixed network cannot know which differences between them are misalignment, so it still averages, over
features now.
"""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor

from advtex_engine.adversarial.pair_sampler import PairSampler
from advtex_engine.methods.descent import descend, gradient_of
from advtex_engine.methods.inputs import LossPoint, MethodInput
from advtex_engine.metrics.lpips import FeatureStack, load_features
from advtex_engine.render.pairs import related_pairs
from advtex_engine.render.streaming import pair_views
from advtex_engine.render.texture import sample_texels

WEIGHTS_VARIABLE = "ADVTEX_VGG_WEIGHTS"
LAYERS = 7
"""Convolutions up to relu3_3; deeper ones see more than what is sharp or blurred, and cost more than all these."""
CROP = 128
"""Pixels; a step on a whole view of 640x480 takes seconds on a CPU."""


def vgg(given: MethodInput) -> tuple[Tensor, list[LossPoint]]:
    """As many steps as the preset has -> [H,W,3] float32 in [0,1] and the losses.

    The features are relu1_2, relu2_2 and relu3_3, compared by their mean absolute difference each. Raises WeightsError
    without weights (see `load_vgg`), and Stopped, after a checkpoint.
    """
    maps, preset, kind = given.maps[1], given.preset, given.scene.kind
    device = maps.device
    features = load_vgg().to(device)
    generator = torch.Generator(device).manual_seed(given.config.seed)
    pairs = related_pairs(maps, kind, preset.max_pair_angle, preset.min_pair_overlap)
    views = pair_views(maps, pairs, given.on_device, given.config.seed)
    sampler = PairSampler(views.maps, views.pairs, kind, (min(CROP, maps.width), min(CROP, maps.height)), generator)

    def distance(values: Tensor, _step: int) -> Tensor:
        pair = sampler.draw()
        render = sampler.image(sample_texels(values, pair.slots, pair.weights))
        # What the auxiliary view does not see is the same in both: the source.
        around = (pair.condition + 1) / 2
        fake = torch.where(pair.visible > 0, render, around)
        with torch.no_grad():
            wanted = features(torch.where(pair.visible > 0, (pair.real + 1) / 2, around))
        return torch.stack([(a - b).abs().mean() for a, b in zip(features(fake), wanted, strict=True)]).sum()

    return descend(given, "vgg", gradient_of(distance), preset.steps, generator, views)


def load_vgg() -> FeatureStack:
    """VGG16 up to relu3_3, from $ADVTEX_VGG_WEIGHTS, else from where LPIPS has its weights. Raises WeightsError."""
    configured = os.environ.get(WEIGHTS_VARIABLE)
    stack = load_features("vgg16", Path(configured) if configured else None)
    stack.layers = stack.layers[:LAYERS]
    return stack
