"""Presets, and what users are told about them."""

from __future__ import annotations

from enum import StrEnum


class Preset(StrEnum):
    """`auto`, or a recipe of the adversarial method. The step counts live in the engine's presets."""

    auto = "auto"
    paper = "paper"
    full = "full"
    standard = "standard"
    preview = "preview"


PRESET_HELP: dict[Preset, str] = {
    Preset.auto: "best and fast on every device: view_selection, one photograph per face, sharpened by all of them",
    Preset.paper: "adversarial as in the paper, from the mean of all photographs, no refined cameras, 50,000 steps",
    Preset.full: "adversarial, from the texture of view_selection, 50,000 small steps; seldom better than standard",
    Preset.standard: "adversarial, from the texture of view_selection, up to 750 steps; minutes on a CPU",
    Preset.preview: "adversarial, from the best photograph per face, coarse to fine; two minutes on a CPU",
}


PRESET_COST: dict[Preset, str] = {
    Preset.auto: "about a minute for views of 320x240 on 2 CPU cores, 3 minutes for 640x480",
    Preset.paper: "about 2 hours for views of 320x240 on 2 CPU cores, 8 hours for 640x480; much less on a GPU",
    Preset.full: "about 2 hours for views of 320x240 on 2 CPU cores, 8 hours for 640x480; much less on a GPU",
    Preset.standard: "1 to 2 minutes for views of 320x240 on 2 CPU cores, 2 to 5 minutes for 640x480",
    Preset.preview: "about 2 minutes for views of 320x240 on 2 CPU cores, 4 minutes for 640x480",
}
