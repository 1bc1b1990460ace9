"""Presets and methods, and what users are told about them."""

from __future__ import annotations

from enum import StrEnum


class Preset(StrEnum):
    """How much work the optimization does. The step counts live in the engine's presets."""

    auto = "auto"
    paper = "paper"
    full = "full"
    standard = "standard"
    preview = "preview"


PRESET_HELP: dict[Preset, str] = {
    Preset.auto: "full on a GPU, standard on a CPU",
    Preset.paper: "the paper's method: starts from the mean of all photographs, no refined cameras, 50,000 steps",
    Preset.full: "starts from the best photograph per face, 50,000 steps; for GPUs",
    Preset.standard: "starts from the best photograph per face, 1,500 steps; minutes on a CPU",
    Preset.preview: "starts from the best photograph per face, coarse to fine; about two minutes on a CPU",
}


PRESET_COST: dict[Preset, str] = {
    Preset.auto: "as full on a GPU, as standard on a CPU",
    Preset.paper: "about 2 hours for views of 320x240 on 2 CPU cores, 8 hours for 640x480; much less on a GPU",
    Preset.full: "about 2 hours for views of 320x240 on 2 CPU cores, 8 hours for 640x480; much less on a GPU",
    Preset.standard: "about 3 minutes for views of 320x240 on 2 CPU cores, 5 minutes for 640x480",
    Preset.preview: "about 2 minutes for views of 320x240 on 2 CPU cores, 4 minutes for 640x480",
}


class Method(StrEnum):
    """How the texture is made. All but `adversarial` are there to compare with it."""

    adversarial = "adversarial"
    adversarial_no_auxiliary = "adversarial_no_auxiliary"
    adversarial_no_condition = "adversarial_no_condition"
    best_view = "best_view"
    colormap = "colormap"
    l1 = "l1"
    mean = "mean"
    sharpest = "sharpest"
    vgg = "vgg"
    view_selection = "view_selection"


METHOD_HELP: dict[Method, str] = {
    Method.adversarial: "the texture is optimized against a patch discriminator",
    Method.adversarial_no_auxiliary: "the same without auxiliary views: what they are worth",
    Method.adversarial_no_condition: "the same without showing the discriminator the source view",
    Method.best_view: "each face from the view that shows it largest",
    Method.colormap: "refined cameras and smoothly corrected photographs, then the mean",
    Method.l1: "least absolute difference to all views",
    Method.mean: "the mean of all views",
    Method.sharpest: "each face from the sharpest view that sees it",
    Method.vgg: "least difference in the features of VGG16, whose weights the worker must have",
    Method.view_selection: "one view per face with few seams, leveled; in about a minute",
}
