"""Splats cut at a height: what lies above a level plane, or below it, and nothing of the rest.

A splat is taken for the surface on which its density is highest along each ray: with covariance S2
of its image position and c, that of image position and depth, the depth there is

    z(p) = z + g . (p - mean2d),    g = S2^-1 c

to first order (the conditional mean of a Gaussian). Of a plane it is 1/z that is linear in the
image, so i(p) = 1/z - g . (p - mean2d) / z^2 is used, which has the same slope. Seen from an eye at
height h_eye over the plane, a point at inverse depth i on the ray through p is at height
z (h_eye i + s(p)), s being the vertical part of the ray's direction. So

    L(p) = h_eye i(p) + s(p)

is linear in p and has the sign of the height: the cut is a straight line in the image. Divided by
its slope, L is a distance from that line in pixels, and clamp(L + 0.5, 0, 1) a smooth edge.
Parallel rays need no such detour: there z(p) is exact for a plane, and the height linear in p.
Where there is a clip, expected and mode depth, too, are taken over these surfaces, 1/i(p), no
farther from the centre than the splat reaches: the centres of large splats stand nearer or farther
than what a pixel shows of them, by more than shallow water is deep. `UNCUT` asks for that and cuts
nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

ABOVE, BELOW = "above", "below"
SIGNS = {ABOVE: 1.0, BELOW: -1.0}
EDGE_PX, OVERLAP_PX = 0.5, 1.0  # added to the distance before it is clamped to [0, 1]
FAR_PX = 1e6  # distances are clamped to this: where the slope vanishes they have no end
SHARP_PX2 = 0.003  # added to S2's diagonal, so that splats seen edge-on have a slope
LONGEST = 2 / 3  # of its depth, that a splat may reach: z(p) is at most 3 z (no matter if parallel)


@dataclass(frozen=True)
class HeightClip:
    """The side of the plane z = z_m (world, metres) that is kept.

    reach_m: splats that lie farther from the plane than this with all they are may be left out,
    where whoever asks could not see them. overlaps: keep one pixel more than half of the edge, for
    a layer that is seen behind the edge of another: nothing shows between them then.
    """

    z_m: float
    keep: Literal["above", "below"]
    reach_m: float = math.inf
    overlaps: bool = False

    def __post_init__(self) -> None:
        if self.keep not in SIGNS or not math.isfinite(self.z_m):
            raise ValueError(
                f"a clip keeps 'above' or 'below' a finite height; "
                f"got {self.keep!r}, z_m = {self.z_m}"
            )
        if not self.reach_m >= 0:
            raise ValueError(f"a clip's reach_m must be >= 0 metres; got {self.reach_m}")

    @property
    def sign(self) -> float:
        """1 where heights above the plane are kept, -1 where those below are."""
        return SIGNS[self.keep]

    @property
    def edge_px(self) -> float:
        """What is added to the distance from the cut, pixels."""
        return EDGE_PX + OVERLAP_PX * self.overlaps


# Nothing is cut: images have the bits of those without a clip, but for depths, which are surfaces'.
UNCUT = HeightClip(z_m=-1e9, keep="above")
