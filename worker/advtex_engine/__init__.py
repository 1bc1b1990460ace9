"""Texture optimization: torch, usable alone, knows no HTTP and no queue."""

import os

# OpenCV reads this once, when it is loaded: an image that claims more pixels than the largest texture (16384 x 16384)
# is refused before memory is taken. Frames of a scan have a lower limit, checked by `ingest` on their headers.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 28))
