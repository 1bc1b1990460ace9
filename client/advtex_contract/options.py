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
    Preset.paper: "the paper as printed: zero start, 50,000 steps",
    Preset.full: "projected-mean start, 50,000 steps; for GPUs",
    Preset.standard: "projected-mean start, 4,000 steps; minutes on a CPU",
    Preset.preview: "a coarse-to-fine pyramid for a first look in about two minutes on a CPU",
}


class JobOptions(BaseModel):
    """What a user may set. Everything has a default that suits most scans."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: Preset = Preset.auto
    width: int | None = Field(default=None, ge=64, le=4096, description="working width of the views, pixels")
    height: int | None = Field(default=None, ge=64, le=4096, description="working height of the views, pixels")
    steps: int | None = Field(default=None, ge=1, le=1_000_000, description="overrides the preset's step count")
    face_budget: int | None = Field(default=None, ge=100, le=2_000_000, description="decimate the mesh to this")
    max_texture_size: int = Field(default=4096, ge=256, le=16384, description="cap on the texture's side, texels")
    holdout: int | None = Field(
        default=None, ge=2, le=1000, description="leave out every Nth sorted frame (position % N == N // 2)"
    )
    seed: int = Field(default=0, ge=0, le=2**31 - 1)

    @model_validator(mode="after")
    def _size_is_whole(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height go together: give both or neither")
        return self
