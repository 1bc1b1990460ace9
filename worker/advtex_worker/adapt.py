"""The user's options as the engine's configuration."""

from __future__ import annotations

from dataclasses import replace

from advtex_contract.options import JobOptions
from advtex_engine.core.config import TextureConfig


def texture_config(options: JobOptions, device: str, memory_bytes: int | None = None) -> TextureConfig:
    """What the engine is asked to do, with so much of a GPU's memory. Raises OptionError."""
    size = (options.width, options.height) if options.width and options.height else None
    config = TextureConfig(
        preset=options.preset.value,
        method=options.method.value,
        size=size,
        holdout=options.holdout,
        steps=options.steps,
        max_texture_size=options.max_texture_size,
        device=device,
        seed=options.seed,
        layout=options.layout,
        memory_bytes=memory_bytes,
    )
    if options.face_budget is not None:
        config = replace(config, face_budget=options.face_budget)
    return config if options.max_views is None else replace(config, max_views=options.max_views)
