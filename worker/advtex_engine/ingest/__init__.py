"""A scan decoded: frames, depth and cameras, and the choice of those that become views."""

from advtex_engine.ingest.frames import Capture, FrameStore
from advtex_engine.ingest.read import read_capture

__all__ = ["Capture", "FrameStore", "read_capture"]
