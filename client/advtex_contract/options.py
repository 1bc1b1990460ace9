"""User-facing knobs of a job: bounds, presets and what they cost."""

from __future__ import annotations

from enum import StrEnum
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


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


class JobOptions(BaseModel):
    """What a user may set. Everything has a default that suits most scans."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: Preset = Preset.auto
    method: Method = Method.adversarial
    width: int | None = Field(default=None, ge=64, le=4096, description="working width of the views, pixels")
    height: int | None = Field(default=None, ge=64, le=4096, description="working height of the views, pixels")
    steps: int | None = Field(default=None, ge=1, le=1_000_000, description="overrides the preset's step count")
    face_budget: int | None = Field(default=None, ge=100, le=2_000_000, description="decimate the mesh to this")
    max_views: int | None = Field(default=None, ge=2, le=2000, description="choose these many frames of a longer scan")
    max_texture_size: int = Field(default=4096, ge=256, le=16384, description="cap on the texture's side, texels")
    holdout: int | None = Field(
        default=None, ge=2, le=1000, description="leave out every Nth sorted frame (position % N == N // 2)"
    )
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    layout: str | None = Field(
        default=None, max_length=40, description="read the files as this layout; otherwise as the one that fits best"
    )

    @model_validator(mode="after")
    def _size_is_whole(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height go together: give both or neither")
        return self
