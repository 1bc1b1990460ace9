"""Texture optimization: torch, usable alone, knows no HTTP and no queue."""

import os

# OpenCV reads this once, when it is loaded: an image that claims more pixels than the largest texture (16384 x 16384)
# is refused before memory is taken. Frames of a scan have a lower limit, checked by `ingest` on their headers.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 28))

# Read once, when torch loads its OpenMP. Threads that spin while they wait steal the core from the thread they wait
# for as soon as anything else runs on the machine: on a busy one a step took 615 ms with spinning and 148 ms without.
os.environ.setdefault("GOMP_SPINCOUNT", "0")
