"""Lenses for tests, with published numbers."""

from __future__ import annotations

from augment.scene.lenses import FThetaLens

# An f-theta camera of 960x740, of a test of NCore (Apache-2.0).
F_THETA = FThetaLens(
    angle_to_distance=(
        0.0,
        473.61334228515625,
        -9.587550163269043,
        24.94717788696289,
        -42.338558197021484,
        15.140613555908203,
    ),
    distance_to_angle=(
        0.0,
        0.002108694054186344,
        1.4248414004214283e-07,
        -8.064807710539412e-10,
        2.485065538765374e-12,
        -1.7939406081105393e-15,
    ),
    limit_rad=1.3461724520632263,
    linear=(0.9997570514678955, 6.27807603450492e-05, -0.00010061755892820656),
)
# Column and row of its principal point, pixels from the first pixel's centre.
F_THETA_CENTRE_PX = (477.8616638183594, 371.405029296875)
