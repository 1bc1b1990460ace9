"""The user's options as the engine's configuration."""

from __future__ import annotations

from advtex_contract.options import JobOptions
from advtex_engine.core.config import TextureConfig


def texture_config(options: JobOptions, device: str, memory_bytes: int | None = None) -> TextureConfig:
    """What the engine is asked to do, with so much of a GPU's memory. Raises OptionError."""
    given = options.model_dump(mode="json")
    width, height = given.pop("width", None), given.pop("height", None)
    size = None if width is None else (width, height)
    return TextureConfig(**given, size=size, device=device, memory_bytes=memory_bytes)
