"""What the kernels that find seen points are given of a view, on CPU and GPU."""

from __future__ import annotations

VIEW = 17  # rotation camera_from_world by rows, fx, cx, fy, centre, 1 where orthographic, cy
CENTRE = 12  # 3 numbers
PARALLEL = 15
