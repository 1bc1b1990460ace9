"""What identifies a run: its caches and checkpoints are taken up by a run of the same fingerprint alone."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from advtex_engine.core.config import PRESETS, TextureConfig
from advtex_engine.ingest.read import opened
from advtex_engine.runtime.checkpoint import FORMAT

# Options on which nothing that is kept depends: neither the texture, nor what it is made of.
NO_RESULT = ("device", "checkpoint_seconds", "memory_bytes", "lossless", "unseen", "outputs")


def fingerprint(scan: Path, config: TextureConfig) -> str:
    """Identifies a run: the state of the scan's files, and every option and number that changes the result.

    A zip keeps its fingerprint wherever it is copied; a folder keeps it where copies keep the files' times.
    Raises ScanError for what cannot be opened.
    """
    with opened(scan) as archive:
        files = archive.stamps()
    options = {key: value for key, value in asdict(config).items() if key not in NO_RESULT}
    presets = {name: asdict(preset) for name, preset in PRESETS.items()}
    content = {"format": FORMAT, "files": files, "options": options, "presets": presets}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
