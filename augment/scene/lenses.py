"""Lenses that are not pinholes: OpenCV's distortion, its fisheye, and NVIDIA's f-theta.

A lens says at which pixel a direction of the camera is shown, and along which direction a pixel
looks. Axes are OpenCV's (x right, y down, z forward), pixel centres lie at +0.5. Everything is
float64 NumPy with one or more leading dimensions, [*, 3] and [*, 2]. The camera holds focal lengths
and principal point, so that a lens stays the same when its image is scaled or cropped.

Other conventions are converted where numbers are read:

* OpenCV and ROS put pixel centres at whole numbers: their cx and cy are smaller by 0.5.
* The principal point of NVIDIA's f-theta cameras counts so, too: add 0.5. The principal points of
  their OpenCV cameras have pixel centres at +0.5 already.

Symbols: theta is the angle between a direction and the optical axis, r a distance from the axis.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

# Coefficients that `OpenCVLens.from_coefficients` takes, in OpenCV's order.
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
# Largest angle to the optical axis of a lens without a limit in its numbers, for OpenCV's pinhole
# with distortion, radians. The tangent has lost all meaning there.
MAX_PINHOLE_ANGLE_RAD = math.radians(89.0)
# Steps of Newton's method, at most. From the table's start, three suffice.
_NUM_STEPS = 20
# Samples of a radial function between the axis and its limit, from which Newton's method starts.
_NUM_SAMPLES = 1025
# Error of an inverse that counts as converged: radians, or units of the image plane at depth 1.
_MAX_ERROR = 1e-10
# Longest distance from the axis at which an f-theta polynomial is looked at, pixels.
_MAX_DISTANCE_PX = 1e6
# Part of a limit by which a value may be beyond it, since limits are rounded numbers themselves.
_ROUNDING = 1e-9


class Intrinsics(NamedTuple):
    """Focal lengths and principal point of an image, pixels, pixel centres at +0.5."""

    fx: float
    """Focal length along x at the optical axis."""
    fy: float
    """Focal length along y at the optical axis."""
    cx: float
    """Column of the principal point."""
    cy: float
    """Row of the principal point."""


@runtime_checkable
class Lens(Protocol):
    """A map between directions of a camera and pixels. Lenses are hashable, and equal by value."""

    is_depth_along_ray: ClassVar[bool]
    """If True, depth is the distance along the ray: the lens may see beyond 90 degrees from its
    axis, where z is negative. If False, depth is z, as for a pinhole."""

    @property
    def max_angle_rad(self) -> float:
        """Return an angle to the optical axis beyond which the lens shows nothing."""
        ...

    def project(
        self, directions: FloatArray, intrinsics: Intrinsics
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels of directions, and the mask of directions that the lens can show.

        Args:
            directions: [*, 3], of any length, in the camera's axes.
            intrinsics: numbers of the image.

        Returns:
            Pixels [*, 2], NaN where the mask [*] is False. The mask is of the lens and not of the
            image: a pixel may lie beyond the image's border.
        """
        ...

    def rays(self, pixels: FloatArray, intrinsics: Intrinsics) -> tuple[FloatArray, BoolArray]:
        """Return the unit directions of pixels, and the mask of pixels that see something.

        Args:
            pixels: [*, 2].
            intrinsics: numbers of the image.

        Returns:
            Directions [*, 3], (0, 0, 1) where the mask [*] is False.
        """
        ...


# ---- OpenCV's pinhole with distortion ------------------------------------------------------------


@dataclass(frozen=True)
class OpenCVLens:
    """Pinhole with radial, tangential and thin prism distortion, as in cv2.projectPoints.

    With x, y on the plane at depth 1 and r^2 = x^2 + y^2, the distorted point is

        x d + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y d + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4

    with d = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6). The lens ends where
    its radial part r d turns back, or has a pole: from there on, one pixel would have two rays.
    """

    radial: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 to k6."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2."""
    thin_prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """s1 to s4."""

    is_depth_along_ray: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_numbers("radial", self.radial, 6)
        _check_numbers("tangential", self.tangential, 2)
        _check_numbers("thin_prism", self.thin_prism, 4)

    @staticmethod
    def from_coefficients(coefficients: Sequence[float]) -> OpenCVLens:
        """Return the lens of a coefficient vector of OpenCV.

        Args:
            coefficients: up to twelve numbers in the order of OPENCV_ORDER; absent ones are 0.

        Raises:
            ValueError: there are more. OpenCV's 13th and 14th tilt the sensor, which is not made.
        """
        numbers = [float(number) for number in coefficients]
        if len(numbers) > len(OPENCV_ORDER) and any(numbers[len(OPENCV_ORDER) :]):
            raise ValueError(
                f"an OpenCV lens has up to {len(OPENCV_ORDER)} coefficients "
                f"({', '.join(OPENCV_ORDER)}); got {len(numbers)}. A tilted sensor (tau_x, tau_y) "
                "cannot be drawn; undistort the images first"
            )
        padded = (numbers + [0.0] * len(OPENCV_ORDER))[: len(OPENCV_ORDER)]
        k1, k2, p1, p2, k3, k4, k5, k6, *thin_prism = padded
        return OpenCVLens(
            radial=(k1, k2, k3, k4, k5, k6),
            tangential=(p1, p2),
            thin_prism=(thin_prism[0], thin_prism[1], thin_prism[2], thin_prism[3]),
        )

    @property
    def max_angle_rad(self) -> float:
        """Return the angle at which the radial distortion turns back, at most 89 degrees."""
        return math.atan(self._max_radius)

    @functools.cached_property
    def _max_radius(self) -> float:
        """Return the radius at depth 1 at which the lens ends."""
        k1, k2, k3, k4, k5, k6 = self.radial
        # In q = r^2, r d = r N / D turns back where N D + 2 q (N' D - N D') = 0. Its pole is D = 0.
        numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
        denominator = np.polynomial.Polynomial([1.0, k4, k5, k6])
        slope = numerator * denominator + np.polynomial.Polynomial([0.0, 2.0]) * (
            numerator.deriv() * denominator - numerator * denominator.deriv()
        )
        end = math.tan(MAX_PINHOLE_ANGLE_RAD) ** 2
        turn = _first_root([float(a) for a in slope.coef], end)
        # At the pole itself the radius is infinite.
        pole = _first_root((1.0, k4, k5, k6), end) * (1 - 1e-6)
        return math.sqrt(min(turn, pole))

    @functools.cached_property
    def _radial_samples(self) -> tuple[FloatArray, FloatArray]:
        """Return radii at depth 1 up to the limit, and the radii that the distortion makes."""
        # Even in angle rather than in radius, since an undistorted lens is open to 89 degrees.
        radii = np.tan(np.linspace(0.0, math.atan(self._max_radius), _NUM_SAMPLES))
        return radii, radii * self._radial_factor(radii * radii)

    def project(
        self, directions: FloatArray, intrinsics: Intrinsics
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels of directions, and the mask of directions that the lens can show.

        Args:
            directions: [*, 3], in the camera's axes.
            intrinsics: numbers of the image.
        """
        directions = np.asarray(directions, np.float64)
        z = directions[..., 2]
        is_ahead = z > 0
        safe_z = np.where(is_ahead, z, 1.0)
        x = np.where(is_ahead, directions[..., 0] / safe_z, 0.0)
        y = np.where(is_ahead, directions[..., 1] / safe_z, 0.0)
        is_inside = is_ahead & (x * x + y * y <= self._max_radius**2 * (1 + _ROUNDING))
        x = np.where(is_inside, x, 0.0)
        y = np.where(is_inside, y, 0.0)
        distorted_x, distorted_y = self._distort(x, y)
        pixels = np.stack(
            [
                intrinsics.fx * distorted_x + intrinsics.cx,
                intrinsics.fy * distorted_y + intrinsics.cy,
            ],
            -1,
        )
        pixels[~is_inside] = np.nan
        return pixels, is_inside

    def rays(self, pixels: FloatArray, intrinsics: Intrinsics) -> tuple[FloatArray, BoolArray]:
        """Return the unit directions of pixels, and the mask of pixels that see something.

        Newton's method in both coordinates, from the inverse of the radial part alone.

        Args:
            pixels: [*, 2].
            intrinsics: numbers of the image.
        """
        pixels = np.asarray(pixels, np.float64)
        shape = pixels.shape[:-1]
        target = (pixels.reshape(-1, 2) - (intrinsics.cx, intrinsics.cy)) / (
            intrinsics.fx,
            intrinsics.fy,
        )
        radii, distorted_radii = self._radial_samples
        target_radius = np.hypot(target[:, 0], target[:, 1])
        start_radius = np.interp(target_radius, distorted_radii, radii)
        # At the axis, the slope of the radial part is 1.
        factor = np.where(target_radius > 0, start_radius / np.maximum(target_radius, 1e-300), 1.0)
        points = target * factor[:, None]
        max_error = _MAX_ERROR * (1 + target_radius)
        is_inside = np.zeros(len(points), bool)
        open_points = np.arange(len(points))  # the points whose solution has not converged
        for _ in range(_NUM_STEPS):
            x, y = points[open_points].T
            distorted_x, distorted_y = self._distort(x, y)
            error_x = distorted_x - target[open_points, 0]
            error_y = distorted_y - target[open_points, 1]
            xx, xy, yx, yy = self._jacobian(x, y)
            determinant = xx * yy - xy * yx
            is_regular = determinant > 1e-12
            safe = np.where(is_regular, determinant, 1.0)
            x = x - (yy * error_x - xy * error_y) / safe
            y = y - (xx * error_y - yx * error_x) / safe
            # A point beyond the lens would run away: it stays at the limit, and never converges.
            shrink = self._max_radius / np.maximum(np.hypot(x, y), self._max_radius)
            points[open_points] = np.stack([x * shrink, y * shrink], -1)
            # Convergence is quadratic: the step just made is as good as the square of this error.
            error = np.hypot(error_x, error_y)
            has_converged = is_regular & (error <= max_error[open_points])
            is_inside[open_points[has_converged]] = True
            open_points = open_points[~has_converged]
            if not len(open_points):
                break
        directions = np.concatenate([points, np.ones_like(points[:, :1])], -1)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        directions[~is_inside] = (0.0, 0.0, 1.0)
        return directions.reshape(*shape, 3), is_inside.reshape(shape)

    def _radial_factor(self, q: FloatArray) -> FloatArray:
        """Return d, by q = r^2."""
        k1, k2, k3, k4, k5, k6 = self.radial
        factor = 1 + q * (k1 + q * (k2 + q * k3))
        if k4 or k5 or k6:
            factor = factor / (1 + q * (k4 + q * (k5 + q * k6)))
        return factor

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distorted coordinates of points on the plane at depth 1."""
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.thin_prism
        q = x * x + y * y
        factor = self._radial_factor(q)
        return (
            x * factor + 2 * p1 * x * y + p2 * (q + 2 * x * x) + q * (s1 + q * s2),
            y * factor + p1 * (q + 2 * y * y) + 2 * p2 * x * y + q * (s3 + q * s4),
        )

    def _jacobian(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the derivatives of `_distort`: of x by x, of x by y, of y by x, of y by y."""
        k1, k2, k3, k4, k5, k6 = self.radial
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.thin_prism
        q = x * x + y * y
        numerator = 1 + q * (k1 + q * (k2 + q * k3))
        denominator = 1 + q * (k4 + q * (k5 + q * k6))
        factor = numerator / denominator
        numerator_slope = k1 + q * (2 * k2 + q * 3 * k3)
        denominator_slope = k4 + q * (2 * k5 + q * 3 * k6)
        slope = (numerator_slope - factor * denominator_slope) / denominator  # of d by q
        prism_x = 2 * (s1 + 2 * q * s2)
        prism_y = 2 * (s3 + 2 * q * s4)
        cross = 2 * x * y * slope
        return (
            factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_x * x,
            cross + 2 * p1 * x + 2 * p2 * y + prism_x * y,
            cross + 2 * p1 * x + 2 * p2 * y + prism_y * x,
            factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_y * y,
        )


# ---- Fisheye -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FisheyeLens:
    """Fisheye after Kannala and Brandt, as in cv2.fisheye, to any angle.

    A direction at theta lies r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) from
    the axis, in focal lengths. The lens ends at `max_angle_rad`, or where r turns back.
    """

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 to k4."""
    limit_rad: float = math.pi
    """Largest angle to the optical axis that the lens shows, radians."""

    is_depth_along_ray: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_numbers("radial", self.radial, 4)
        _check_limit(self.limit_rad)

    @property
    def max_angle_rad(self) -> float:
        """Return the angle to the optical axis beyond which the lens shows nothing."""
        return self._max_angle_rad

    @functools.cached_property
    def _max_angle_rad(self) -> float:
        """Return `limit_rad`, or the smaller angle at which r turns back."""
        return min(self.limit_rad, math.sqrt(_first_root(self._slope_polynomial, math.pi**2)))

    def project(
        self, directions: FloatArray, intrinsics: Intrinsics
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels of directions, and the mask of directions that the lens can show.

        Args:
            directions: [*, 3], in the camera's axes.
            intrinsics: numbers of the image.
        """
        angle, unit, is_inside = _polar_directions(directions, self.max_angle_rad)
        offset = unit * self._radius(angle)[..., None]
        pixels = offset * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)
        pixels[~is_inside] = np.nan
        return pixels, is_inside

    def rays(self, pixels: FloatArray, intrinsics: Intrinsics) -> tuple[FloatArray, BoolArray]:
        """Return the unit directions of pixels, and the mask of pixels that see something.

        Args:
            pixels: [*, 2].
            intrinsics: numbers of the image.
        """
        pixels = np.asarray(pixels, np.float64)
        offset = (pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
        radius = np.hypot(offset[..., 0], offset[..., 1])
        angle, is_inside = _invert(self._radius, self._slope, self._samples, radius)
        return _directions(offset, radius, angle, is_inside)

    @functools.cached_property
    def _samples(self) -> tuple[FloatArray, FloatArray]:
        """Return angles up to the limit, and their radii in focal lengths."""
        angles = np.linspace(0.0, self.max_angle_rad, _NUM_SAMPLES)
        return angles, self._radius(angles)

    def _radius(self, angle: FloatArray) -> FloatArray:
        """Return the distance from the axis of an angle, focal lengths."""
        return angle * _evaluate_polynomial((1.0, *self.radial), angle * angle)

    def _slope(self, angle: FloatArray) -> FloatArray:
        """Return the derivative of `_radius`."""
        return _evaluate_polynomial(self._slope_polynomial, angle * angle)

    @property
    def _slope_polynomial(self) -> list[float]:
        """Return the coefficients of `_slope` in theta^2, from the power 0."""
        return [(2 * i + 1) * k for i, k in enumerate((1.0, *self.radial))]


# ---- F-theta -------------------------------------------------------------------------------------


AngleToDistance = Literal["angle_to_distance"]
DistanceToAngle = Literal["distance_to_angle"]


@dataclass(frozen=True)
class FThetaLens:
    """NVIDIA's f-theta lens: polynomials between the angle and the distance in the image.

    A direction at theta lies r(theta) from the axis, in pixels of the calibrated image. With
    (x, y) of this length, the pixel's offset from the principal point is (c x + d y, e x + y). One
    polynomial is the reference; the inverse is solved, and the other one is where it starts.

    Camera.fx and Camera.fy are the slope of r at the axis (`slope_px`) in the calibrated image, and
    become larger and smaller with the image's size as those of a pinhole do.
    """

    angle_to_distance: tuple[float, ...]
    """Distance in pixels by angle in radians: coefficients from the power 0, which is 0."""
    distance_to_angle: tuple[float, ...]
    """Angle in radians by distance in pixels: coefficients from the power 0, which is 0."""
    reference: AngleToDistance | DistanceToAngle = "angle_to_distance"
    """The polynomial that defines the lens."""
    limit_rad: float = math.pi
    """Largest angle to the optical axis that the lens shows, radians."""
    linear: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """c, d and e of the linear part."""

    is_depth_along_ray: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.reference not in ("angle_to_distance", "distance_to_angle"):
            raise ValueError(
                "the reference of an f-theta lens must be 'angle_to_distance' or "
                f"'distance_to_angle'; got {self.reference!r}"
            )
        _check_limit(self.limit_rad)
        _check_numbers("linear", self.linear, 3)
        c, d, e = self.linear
        if not c - d * e > 0:
            raise ValueError(
                "the linear part (c, d, e) of an f-theta lens must keep the orientation of the "
                f"image: c - d e must be > 0; got {self.linear}"
            )
        polynomial = self._reference_polynomial
        name = self.reference
        if len(polynomial) < 2:
            raise ValueError(
                f"{name} of an f-theta lens is its reference and must have 2 or more coefficients; "
                f"got {len(polynomial)}"
            )
        for key in ("angle_to_distance", "distance_to_angle"):
            numbers = getattr(self, key)
            _check_numbers(key, numbers, len(numbers))
        if polynomial[0] != 0 or not polynomial[1] > 0:
            raise ValueError(
                f"{name} of an f-theta lens must begin with 0 (the axis is at the principal point) "
                f"and a positive slope; got {polynomial[0]:g}, {polynomial[1]:g}"
            )

    @property
    def slope_px(self) -> float:
        """Return the focal length at the axis in the calibrated image, pixels a radian."""
        slope = self._reference_polynomial[1]
        return slope if self.reference == "angle_to_distance" else 1 / slope

    @property
    def max_angle_rad(self) -> float:
        """Return the angle to the optical axis beyond which the lens shows nothing."""
        return self._max_angle_rad

    @functools.cached_property
    def _max_angle_rad(self) -> float:
        """Return `limit_rad`, or the smaller angle at which the reference turns back."""
        if self.reference == "angle_to_distance":
            return self._max_argument
        return float(self._evaluate(np.array([self._max_argument]))[0])

    @functools.cached_property
    def _max_argument(self) -> float:
        """Return the end of the reference's range: where it turns back, or reaches `limit_rad`."""
        polynomial = self._reference_polynomial
        if self.reference == "angle_to_distance":
            return _first_root(_derivative(polynomial), self.limit_rad)
        turn_px = _first_root(_derivative(polynomial), _MAX_DISTANCE_PX)
        return _first_root((-self.limit_rad, *polynomial[1:]), turn_px)

    def project(
        self, directions: FloatArray, intrinsics: Intrinsics
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels of directions, and the mask of directions that the lens can show.

        Args:
            directions: [*, 3], in the camera's axes.
            intrinsics: numbers of the image.
        """
        angle, unit, is_inside = _polar_directions(directions, self.max_angle_rad)
        if self.reference == "angle_to_distance":
            distance_px = self._evaluate(angle)
        else:
            distance_px, has_converged = _invert(
                self._evaluate, self._evaluate_slope, self._samples, angle
            )
            is_inside = is_inside & has_converged
        offset = unit * distance_px[..., None]
        c, d, e = self.linear
        scale_x = intrinsics.fx / self.slope_px
        scale_y = intrinsics.fy / self.slope_px
        pixels = np.stack(
            [
                scale_x * (c * offset[..., 0] + d * offset[..., 1]) + intrinsics.cx,
                scale_y * (e * offset[..., 0] + offset[..., 1]) + intrinsics.cy,
            ],
            -1,
        )
        pixels[~is_inside] = np.nan
        return pixels, is_inside

    def rays(self, pixels: FloatArray, intrinsics: Intrinsics) -> tuple[FloatArray, BoolArray]:
        """Return the unit directions of pixels, and the mask of pixels that see something.

        Args:
            pixels: [*, 2].
            intrinsics: numbers of the image.
        """
        pixels = np.asarray(pixels, np.float64)
        across = (pixels[..., 0] - intrinsics.cx) * (self.slope_px / intrinsics.fx)
        down = (pixels[..., 1] - intrinsics.cy) * (self.slope_px / intrinsics.fy)
        c, d, e = self.linear
        determinant = c - d * e
        offset = np.stack([across - d * down, c * down - e * across], -1) / determinant
        distance_px = np.hypot(offset[..., 0], offset[..., 1])
        if self.reference == "angle_to_distance":
            angle, is_inside = _invert(
                self._evaluate, self._evaluate_slope, self._samples, distance_px
            )
        else:
            limit_px = self._max_argument
            is_inside = distance_px <= limit_px * (1 + _ROUNDING)
            angle = self._evaluate(np.minimum(distance_px, limit_px))
        return _directions(offset, distance_px, angle, is_inside)

    @property
    def _reference_polynomial(self) -> tuple[float, ...]:
        """Return the polynomial that defines the lens."""
        if self.reference == "angle_to_distance":
            return self.angle_to_distance
        return self.distance_to_angle

    @functools.cached_property
    def _samples(self) -> tuple[FloatArray, FloatArray]:
        """Return arguments of the reference up to the lens's limit, and its values there."""
        arguments = np.linspace(0.0, self._max_argument, _NUM_SAMPLES)
        return arguments, self._evaluate(arguments)

    def _evaluate(self, arguments: FloatArray) -> FloatArray:
        """Return the reference polynomial's values."""
        return _evaluate_polynomial(self._reference_polynomial, arguments)

    def _evaluate_slope(self, arguments: FloatArray) -> FloatArray:
        """Return the derivative of the reference polynomial."""
        slope = _derivative(self._reference_polynomial)
        return _evaluate_polynomial(slope, arguments)


# ---- Functions that lenses share -----------------------------------------------------------------


def _check_numbers(name: str, numbers: Sequence[float], length: int) -> None:
    """Raise ValueError unless there are `length` finite numbers."""
    if len(numbers) != length or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{name} of a lens must be {length} finite numbers; got {tuple(numbers)}")


def _check_limit(limit_rad: float) -> None:
    """Raise ValueError unless an angle is above 0 and at most a half turn."""
    if not 0 < limit_rad <= math.pi:
        raise ValueError(
            f"limit_rad of a lens must be above 0 and at most pi (180 degrees from the axis); "
            f"got {limit_rad}"
        )


def _first_root(coefficients: Sequence[float], end: float) -> float:
    """Return the smallest positive root of a polynomial, or `end` if there is none up to it.

    Args:
        coefficients: from the power 0.
        end: largest root that matters.
    """
    trimmed = np.trim_zeros(np.asarray(coefficients, np.float64), "b")
    if len(trimmed) < 2:
        return end
    roots = np.roots(trimmed[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))) & (roots.real > 0)]
    return min(float(real.min(initial=end)), end)


def _evaluate_polynomial(polynomial: Sequence[float], arguments: FloatArray) -> FloatArray:
    """Return the values of a polynomial, by Horner's rule.

    Args:
        polynomial: coefficients from the power 0.
        arguments: [*].
    """
    values = np.full_like(arguments, polynomial[-1])
    for coefficient in polynomial[-2::-1]:
        values = values * arguments + coefficient
    return values


def _derivative(polynomial: Sequence[float]) -> list[float]:
    """Return the coefficients of a polynomial's derivative, from the power 0."""
    return [power * number for power, number in enumerate(polynomial)][1:]


def _polar_directions(
    directions: FloatArray, max_angle_rad: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return directions as angles to the axis [*] and unit offsets in the image [*, 2].

    Args:
        directions: [*, 3], of any length.
        max_angle_rad: limit of the lens.

    Returns:
        Angles, 0 where the lens does not reach; offsets, (1, 0) at the axis; the mask of directions
        within the limit. A direction of length 0 has no angle, and is outside.
    """
    directions = np.asarray(directions, np.float64)
    sideways = np.hypot(directions[..., 0], directions[..., 1])
    angle = np.arctan2(sideways, directions[..., 2])
    has_length = (sideways > 0) | (directions[..., 2] != 0)
    is_inside = has_length & (angle <= max_angle_rad * (1 + _ROUNDING))
    safe = np.where(sideways > 0, sideways, 1.0)
    unit = directions[..., :2] / safe[..., None]
    unit = np.where((sideways > 0)[..., None], unit, (1.0, 0.0))
    return np.where(is_inside, angle, 0.0), unit, is_inside


def _directions(
    offset: FloatArray, radius: FloatArray, angle: FloatArray, is_inside: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Return unit directions [*, 3] at an angle to the axis, towards an offset in the image.

    Args:
        offset: [*, 2].
        radius: length of the offset, [*].
        angle: radians, [*].
        is_inside: mask of the angles that hold; the others give (0, 0, 1).
    """
    unit = offset / np.where(radius > 0, radius, 1.0)[..., None]
    directions = np.concatenate(
        [unit * np.sin(angle)[..., None], np.cos(angle)[..., None]], axis=-1
    )
    directions[~is_inside] = (0.0, 0.0, 1.0)
    return directions, is_inside


def _invert(
    function: Callable[[FloatArray], FloatArray],
    slope: Callable[[FloatArray], FloatArray],
    samples: tuple[FloatArray, FloatArray],
    values: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Return the arguments at which a growing function has values, by Newton's method.

    Args:
        function: grows over the range of the samples, and is 0 at 0.
        slope: its derivative.
        samples: arguments over the whole range, and the function's values there.
        values: [*].

    Returns:
        Arguments [*], and the mask [*] of values within the range whose solution has converged.
    """
    arguments, sampled = samples
    end = arguments[-1]
    is_inside = (values >= 0) & (values <= sampled[-1] * (1 + _ROUNDING))
    target = np.where(is_inside, values, 0.0)
    solution = np.interp(target, sampled, arguments)
    for _ in range(_NUM_STEPS):
        error = function(solution) - target
        if np.abs(error).max(initial=0.0) <= 1e-14 * sampled[-1]:
            break
        step = error / np.maximum(slope(solution), 1e-9 * sampled[-1] / end)
        solution = np.clip(solution - step, 0.0, end)
    error = np.abs(function(solution) - target)
    # At the end of the range the slope may be 0: there the rounding of the limit is allowed.
    is_inside &= error <= _MAX_ERROR * sampled[-1] + _ROUNDING * target
    return solution, is_inside
