"""Texture optimization: torch, usable alone, knows no HTTP and no queue."""

import os

# OpenCV reads this once, when it is loaded: an image that claims more pixels than the largest texture (16384 x 16384)
# is refused before memory is taken. Frames of a scan have a lower limit, checked by `ingest` on their headers.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 28))

# Read once, when torch loads its OpenMP: how often a waiting thread looks before it sleeps. Long spinning steals the
# core from the thread that is waited for as soon as anything else runs on the machine, none at all costs a wake-up per
# operation. Milliseconds per step (`advtex-engine bench`, 320x240, 2 cores) idle / with three busy threads beside it:
# 0: 147 / 299; 10,000: 99 / 435; 100,000: 93 / 1038. OpenMP's own choice when idle: 88.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
