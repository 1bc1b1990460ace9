"""What the apps that record with Apple's ARKit share.

The world is in metres with y up. Camera axes are OpenGL's unless the app turns them itself. Intrinsics count the
image's corner as (0, 0), and belong to the color image as the sensor has it; depth and confidence are registered to it
at a lower resolution. The LiDAR sensor measures up to 5 metres; what it says beyond is a guess.
"""

from __future__ import annotations

from advtex_scan.manifest import UpAxis

UP_AXIS: UpAxis = "+y"
LIDAR_METRES = 5.0
CONFIDENCE_HIGH = 2  # of ARConfidenceLevel: 0 low, 1 medium, 2 high
