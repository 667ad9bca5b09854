"""Opaque splats that close places below the horizon where the LiDAR has no return.

A LiDAR sees neither the road beside its own car nor much of dark paint and glass, and splats
between its returns leak. An uncovered place would belong to the sky, with flat fog and a hollow in
a flood. One recorded image after another is compared with the Gaussians so far: where light comes
through below the horizon, a disc in the photo's colour is placed

    behind a surface that leaks       a little further than it, of its class and object;
    into a labelled box               where the ray passes through it: paint and glass; of vehicles
                                      also where they are looked through, from roof to sill;
    on the ground                     where the surface around is ground;
    else as far as the surroundings   of the surfaces nearest in place and colour, and never below
                                      the ground.

The surroundings combine place and colour (as a joint bilateral filter does), so that a depth ends
where the photo has an edge. The caller is `adapters.lidar_scene.scene`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from adapters.lidar_scene.image_views import IMAGE_SCALES, View, draw_cover, read_image
from adapters.lidar_scene.split import SKIN_M, ObjectTrack, PointSet, is_flat
from adapters.lidar_scene.surfels import SplatShape, Surfels, gaussians_from_surfels, ground_points
from adapters.raw_drive import BoxSample
from adapters.world import join_gaussians
from augment.render.buffers import ALPHA, MEDIAN_DEPTH, SPLAT_IDS
from augment.render.constants import SURFACE_ALPHA
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass, class_of_label

_WIDTH = 480  # columns of the images that are drawn
_CELL_PX = 2  # smallest spacing of new discs, pixels of those images
_MAX_CELL_PX = 8  # spacing that is doubled no further, pixels: larger discs hide the sky

_STEP_M = 1.2  # distance on the path from one image that is taken to the next
_MIN_FRAMES = 4  # smallest limit on the number of frames whose images are taken
_FRAMES_PART = 1 / 3  # the limit as a part of all frames, where that is more
_TRANSMITTANCE = 0.02  # largest transmittance of a closed pixel
_BEHIND = 0.002  # gap from a surface that leaks to the disc behind it, as a part of the depth
_BEHIND_M = 0.02  # constant part of that gap, metres
_NEIGHBOURS = 16  # cells with a surface that are compared for one hole
_FAR_QUANTILE = 0.75  # quantile of the neighbours' depths that the hole takes
_CELLS_PER_LAB = 1.0  # a difference in colour (CIELAB) as a distance in the image
_SQUARE_M = 0.5  # side of a square in the map of the ground
_ON_GROUND_M = 0.2  # height below which a surface counts as ground
_FURTHEST_M = 300.0  # largest depth of a disc
_CAR_M = 3.0  # depth up to which the recording car itself is in the way of most rays
_NEAREST_DISC_M = 0.2  # smallest depth of a disc: nothing is nearer to a camera on a car
_STRETCH = 20.0  # largest length over width of a disc on the ground that is seen at a slant
_SOLID = 0.4  # part of a box's narrower side that a ray must pass to meet what is in it
_SKIN = 0.15  # depth of paint and glass in a box, as part of the ray's length through it
_NEAREST_M = 0.1  # smallest depth at which a ray may enter a box that is filled
_FURTHEST_BOX_M = 40.0  # largest depth of the nearest corner of a box that is filled
_NEAR_BOX_M = 0.15  # accuracy of labelled boxes
_MIN_OWN = 8  # cells that must show a vehicle's surface before the rest of it is filled
_SMOOTH = 9  # side of the square that depths behind a box's side are averaged over, cells
_SILL_M = 0.25  # height of a vehicle's sill above the ground
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
# Discs on a grid of their own pitch let 2 % through at most, between four of them.
_SHAPE = SplatShape(sigma_per_spacing=0.8, opacity=0.99)


def close_parts(
    parts: Sequence[Gaussians],
    tracks: Sequence[ObjectTrack],
    still: Sequence[BoxSample],
    views: Sequence[View],
    points: PointSet,
    *,
    max_gaussians: int,
) -> list[Gaussians]:
    """Return the Gaussians with discs added until few pixels of the images are open below the
    horizon.

    Args:
        parts: Gaussians of the world, then those of the tracks, in their frames.
        tracks: moving objects.
        still: boxes of objects that are part of the world.
        views: recorded images.
        points: points of the world, the ground among them.
        max_gaussians: largest number for all parts. Near it discs are larger, and far ones are left
            out.
    """
    parts = list(parts)
    ground = _GroundMap.of(points)
    still_boxes = [
        _Box(0, box.world_from_box, np.asarray(box.size_m), class_of_label(box.label))
        for box in still
    ]
    for view in spread_views(views, step_m=_STEP_M, frames_part=_FRAMES_PART):
        poses = {0: np.eye(4)}
        for number, track in enumerate(tracks, start=1):
            pose = track.motion.pose_at(view.camera.timestamp_ns)
            if pose is not None:
                poses[number] = pose
        boxes = still_boxes + [
            _Box(n, pose, tracks[n - 1].size_m, class_of_label(tracks[n - 1].label))
            for n, pose in poses.items()
            if n
        ]
        centre = view.camera.centre.numpy()
        boxes.sort(key=lambda box: -np.linalg.norm(box.world_from_box[:3, 3] - centre))
        rendering = _draw(parts, poses, view.camera)
        photo = _read_photo(view, rendering.camera, boxes)
        if photo is None:
            continue  # a problem of the scene already
        side_px = _CELL_PX
        max_discs = (max_gaussians - sum(map(len, parts))) // 2
        while True:
            cells = rendering.cells(side_px)
            # Of a nearer box after, and so over, those of a further one.
            discs = _discs(cells, photo.resized(cells.camera), ground, boxes)
            if len(discs.part) <= max_discs or side_px >= _MAX_CELL_PX:
                break
            side_px *= 2
        if len(discs.part) > max_discs:  # what is near shows in fog and water
            discs = discs.select(np.sort(np.argsort(discs.depth, kind="stable")[:max_discs]))
        for number in np.unique(discs.part):
            part_discs = discs.select(discs.part == number)
            new = part_discs.gaussians(cells.camera, poses[int(number)])
            parts[number] = join_gaussians([parts[number], new])
    return parts


def spread_views(views: Sequence[View], *, step_m: float, frames_part: float) -> list[View]:
    """Return the views of frames step_m apart, the first and the last among them.

    Of more frames than frames_part of all and _MIN_FRAMES, as many are taken.
    """
    by_frame: dict[int, list[View]] = {}
    for view in views:
        by_frame.setdefault(view.frame, []).append(view)
    frames = list(by_frame.values())
    spread = []
    last_centre = None
    for number, frame_views in enumerate(frames):
        centre = frame_views[0].camera.centre.numpy()
        if (
            last_centre is None
            or np.linalg.norm(centre - last_centre) >= step_m
            or number == len(frames) - 1
        ):
            spread.append(frame_views)
            last_centre = centre
    count = min(len(spread), max(_MIN_FRAMES, round(frames_part * len(frames))))
    places = np.linspace(0, len(spread) - 1, count).round().astype(int)
    return [view for place in places for view in spread[place]]


@dataclass(frozen=True, eq=False)
class _GroundMap:
    """The ground in squares seen from above.

    Attributes:
        corner: float64 [2], corner of the first square.
        heights: float64 [X, Y], of the nearest square that holds ground.
        semantic: int16 [X, Y], class of the same square.
    """

    corner: np.ndarray
    heights: np.ndarray
    semantic: np.ndarray

    @staticmethod
    def of(points: PointSet) -> _GroundMap | None:
        """Return the map of points, or None without ground."""
        flat = ground_points(points) if len(points) else np.zeros(0, np.bool_)
        if not flat.any():
            return None
        xyz = points.points[flat].astype(np.float64)
        corner = xyz[:, :2].min(axis=0)
        i, j = np.floor((xyz[:, :2] - corner) / _SQUARE_M).astype(np.int64).T
        shape = (i.max() + 1, j.max() + 1)
        heights = np.zeros(shape)
        semantic = np.zeros(shape, np.int16)
        count = np.zeros(shape)
        np.add.at(heights, (i, j), xyz[:, 2])
        np.add.at(count, (i, j), 1)
        semantic[i, j] = points.semantic[flat]
        heights /= np.maximum(count, 1)
        has_ground = count > 0
        return _GroundMap(
            corner, _from_nearest(heights, has_ground), _from_nearest(semantic, has_ground)
        )

    def square(self, xy: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the indices of the squares nearest to places [..., 2]."""
        index = np.floor((xy - self.corner) / _SQUARE_M).astype(np.int64)
        index = np.clip(index, 0, np.array(self.heights.shape) - 1)
        return index[..., 0], index[..., 1]


def _from_nearest(image: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Return the image [H, W] with each unknown pixel's value from the known one nearest to it."""
    _, labels = cv2.distanceTransformWithLabels(
        (~is_known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(labels.max() + 1, image.dtype)
    values[labels[is_known]] = image[is_known]
    return values[labels]


def _meet_ground(
    ground: _GroundMap | None, centre: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the multiple of each ray [..., 3] from the centre to the ground, and the class
    there.

    The multiple is infinite without ground within _FURTHEST_M. The height at the last place is
    taken for the next iteration, which converges on roads. If the ground rises above the eye, it
    may not converge, and may end before the lens: that is no place on the ground.
    """
    shape = rays.shape[:-1]
    if ground is None:
        return np.full(shape, np.inf), np.zeros(shape, np.int16)
    times = np.zeros(shape)
    down = np.maximum(-rays[..., 2], 1e-9)
    for _ in range(5):
        square = ground.square(centre[:2] + times[..., None] * rays[..., :2])
        times = np.clip((centre[2] - ground.heights[square]) / down, 0.1, _FURTHEST_M)
    square_under = ground.square(centre[:2] + times[..., None] * rays[..., :2])
    height_m = centre[2] - times * down - ground.heights[square_under]
    is_in_air = (times < _CAR_M) & (height_m > _ON_GROUND_M)
    return np.where(is_in_air, np.inf, times), ground.semantic[square]


class _Cells(NamedTuple):
    """A rendered view in square cells of pixels.

    Each cell has the values of its most open pixel.

    Attributes:
        camera: camera whose pixels are the cells.
        is_open: bool [h, w], True where light comes through below the horizon.
        has_surface: bool [h, w].
        depth: float64 [h, w].
        part, semantic: int [h, w], of the splat of largest weight.
    """

    camera: Camera
    is_open: np.ndarray
    has_surface: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    semantic: np.ndarray


class _RenderedView(NamedTuple):
    """A rendered view.

    Attributes:
        alpha, depth: float32 [H, W].
        part, semantic: int [H, W], of the splat of largest weight, at pixels with a surface.
    """

    camera: Camera
    alpha: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    semantic: np.ndarray

    def cells(self, side_px: int) -> _Cells:
        camera = self.camera
        rows = -(-camera.height // side_px)
        columns = -(-camera.width // side_px)
        small = dataclasses.replace(
            camera,
            width=columns,
            height=rows,
            fx=camera.fx / side_px,
            fy=camera.fy / side_px,
            cx=camera.cx / side_px,
            cy=camera.cy / side_px,
        )

        def blocks(image: np.ndarray) -> np.ndarray:
            """Return blocks of pixels [h, w, side_px^2]. Those at the border repeat its pixels."""
            beyond = ((0, rows * side_px - camera.height), (0, columns * side_px - camera.width))
            padded = np.pad(image, beyond, mode="edge")
            split = padded.reshape(rows, side_px, columns, side_px).swapaxes(1, 2)
            return split.reshape(rows, columns, -1)

        most_open = blocks(self.alpha).argmin(2)[..., None]
        alpha, depth, part, semantic = (
            np.take_along_axis(blocks(image), most_open, 2)[..., 0] for image in self[1:]
        )
        # Half a cell above the horizon counts: splats there are seen from lower cameras too.
        below = small.ray_directions().numpy()[..., 2] < 0.5 / small.fy
        return _Cells(
            small,
            (alpha < 1 - _TRANSMITTANCE) & below,
            alpha >= SURFACE_ALPHA,
            depth.astype(np.float64),
            part,
            semantic,
        )


def _draw(
    parts: Sequence[Gaussians], poses: dict[int, np.ndarray], camera: Camera
) -> _RenderedView:
    camera = camera.scaled(min(1.0, _WIDTH / camera.width))
    posed_gaussians = [
        PosedGaussians(parts[n], torch.from_numpy(pose) if n else None, instance_id=n)
        for n, pose in poses.items()
    ]
    raster = rasterize(posed_gaussians, camera, buffers=(ALPHA, MEDIAN_DEPTH, SPLAT_IDS))
    assert raster.alpha is not None and raster.median_depth is not None
    assert raster.splat_ids is not None
    ids = raster.splat_ids.numpy().clip(0)
    # One more than there are: of an image in which nothing stands.
    part = np.append(np.repeat(list(poses), [len(parts[n]) for n in poses]), 0)
    classes = [parts[n].semantic.numpy() for n in poses if len(parts[n])]
    semantic = np.concatenate([*classes, np.zeros(1, np.int16)])
    return _RenderedView(
        camera, raster.alpha.numpy(), raster.median_depth.numpy(), part[ids], semantic[ids]
    )


class _Photo(NamedTuple):
    """One recorded image at the size of the cells.

    Attributes:
        image: RGB uint8 [h, w, 3]. The recording car's pixels are filled from around it.
        still: the same, with the moving objects' pixels filled too.
    """

    image: np.ndarray
    still: np.ndarray

    def resized(self, camera: Camera) -> _Photo:
        size = (camera.width, camera.height)
        return _Photo(*(cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in self))


def _read_photo(view: View, camera: Camera, boxes: Sequence[_Box]) -> _Photo | None:
    """Read the photo at about half the camera's size, or None if it cannot be decoded."""
    scale = camera.width / view.camera.width
    image = read_image(view.path, next(s for s in IMAGE_SCALES if s >= scale))
    if image is None:
        return None
    small = camera.scaled(1 / _CELL_PX)
    size = (small.width, small.height)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    car = view.shows_car(*size)
    cover = np.full(car.shape, np.inf, np.float32)
    for box in boxes:
        if box.part:
            pose = small.camera_from_world.numpy() @ box.world_from_box
            draw_cover(cover, small, pose, box.size_m)
    return _Photo(_filled(image, car), _filled(image, car | np.isfinite(cover)))


def _filled(image: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    if unknown.all() or not unknown.any():
        return image
    return cv2.inpaint(image, unknown.astype(np.uint8), 3, cv2.INPAINT_TELEA)


class _Discs(NamedTuple):
    """M new discs.

    Attributes:
        part: int [M], part that gets the disc.
        points: float64 [M, 3], world.
        rays: float64 [M, 3], world, with unit z in the camera.
        depth: float64 [M].
        lies: bool [M], True on the ground.
        semantic: int16 [M].
        colours: float32 [M, 3].
    """

    part: np.ndarray
    points: np.ndarray
    rays: np.ndarray
    depth: np.ndarray
    lies: np.ndarray
    semantic: np.ndarray
    colours: np.ndarray

    def select(self, keep: np.ndarray) -> _Discs:
        return _Discs(*(column[keep] for column in self))

    def gaussians(self, camera: Camera, world_from_part: np.ndarray) -> Gaussians:
        """Return the discs as Gaussians: level on the ground, else facing the camera.

        As large as a pixel.
        """
        lengths = np.linalg.norm(self.rays, axis=1, keepdims=True)
        up = np.array([0.0, 0.0, 1.0])
        normals = np.where(self.lies[:, None], up, self.rays / lengths)
        aside = np.cross(self.rays, up)
        aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
        along = np.cross(normals, aside)
        pitch = self.depth / camera.fx
        slant = np.minimum(lengths[:, 0] / np.maximum(np.abs(self.rays[:, 2]), 1e-9), _STRETCH)
        spacing = np.stack([pitch * np.where(self.lies, slant, 1.0), pitch], 1)
        turn = world_from_part[:3, :3]
        local = (self.points - world_from_part[:3, 3]) @ turn
        floats = [a.astype(np.float32) for a in (local, normals @ turn, along @ turn, spacing)]
        count = len(local)
        surfels = Surfels(*floats, np.zeros(count, np.bool_), np.zeros((count, 0), np.int64))
        return gaussians_from_surfels(surfels, self.colours, self.semantic, _SHAPE)


def _discs(
    cells: _Cells, photo: _Photo, ground: _GroundMap | None, boxes: Sequence[_Box]
) -> _Discs:
    """Return a disc for each open cell, and for cells that show something through a vehicle's
    box.
    """
    centre = cells.camera.centre.numpy()
    rays = cells.camera.ray_directions(torch.float64).numpy()
    ground_depth, ground_class = _meet_ground(ground, centre, rays)
    # Heights over the ground further along the ray: over a road, the same.
    height_m = (ground_depth - cells.depth) * -rays[..., 2]
    flat = (height_m < _ON_GROUND_M) & (cells.part == 0)
    holes = cells.is_open & ~cells.has_surface
    flat |= is_flat(cells.semantic) & (cells.part == 0)
    disc_depth = cells.depth * (1 + _BEHIND) + _BEHIND_M
    semantic = cells.semantic
    on_ground = flat
    # What a ray meets behind ground that leaks is ground.
    disc_depth = np.where(
        flat & np.isfinite(ground_depth), np.maximum(disc_depth, ground_depth), disc_depth
    )
    if holes.any():
        surface_cell = _nearest_surfaces(cells, photo.image, holes)
        surface_depth = cells.depth.ravel()[surface_cell]
        # What is around may be an object whose box ends there: the ground goes on beside it.
        meets_ground = flat.ravel()[surface_cell] | (cells.part.ravel()[surface_cell] > 0)
        meets_ground |= surface_depth >= ground_depth[holes]
        meets_ground &= np.isfinite(ground_depth[holes])
        disc_depth[holes] = np.where(meets_ground, ground_depth[holes], surface_depth)
        semantic[holes] = np.where(
            meets_ground, ground_class[holes], semantic.ravel()[surface_cell]
        )
        on_ground[holes] = meets_ground
    part = np.where(holes, 0, cells.part)
    close = cells.is_open.copy()
    for box in boxes:
        window, inside, depth = _fill_box(
            box, cells, centre, rays, ground_depth, height_m, disc_depth
        )
        part[window][inside] = box.part
        disc_depth[window][inside] = depth[inside]
        semantic[window][inside] = box.semantic
        on_ground[window][inside] = False
        close[window] |= inside
        if box.part:  # beside a silhouette, what is behind may count as the object's
            close &= (part != box.part) | box.holds(centre + disc_depth[..., None] * rays)
    # Nearer, no distance is known, and a disc would hide all.
    close &= disc_depth >= _NEAREST_DISC_M
    depth = np.minimum(disc_depth[close], _FURTHEST_M)
    points = centre + depth[:, None] * rays[close]
    colours = np.where(part[close][:, None] > 0, photo.image[close], photo.still[close]) / 255
    return _Discs(
        part[close],
        points,
        rays[close],
        depth,
        on_ground[close],
        semantic[close],
        colours.astype(np.float32),
    )


def _nearest_surfaces(cells: _Cells, image: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Return the flat index of the cell whose depth each hole takes, int64 [holes].

    The cells with a surface that are nearest to the hole in place and colour are compared. The one
    at _FAR_QUANTILE of their depths is taken: a near object is the less likely to go on.
    """
    surface_cells = np.flatnonzero(cells.has_surface & (cells.depth < _FURTHEST_M))
    if not len(surface_cells):
        return np.flatnonzero(holes)  # themselves, at no depth
    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    rows, columns = np.mgrid[: holes.shape[0], : holes.shape[1]]
    places = np.dstack([rows, columns, lab * np.float32(_CELLS_PER_LAB)])
    tree = cKDTree(places.reshape(-1, 5)[surface_cells])
    k = min(_NEIGHBOURS, len(surface_cells))
    index = tree.query(places[holes], k=[*range(1, k + 1)], workers=-1)[1]
    order = np.argsort(cells.depth.ravel()[surface_cells][index], axis=1, kind="stable")
    far_neighbour = order[:, min(int(_FAR_QUANTILE * k), k - 1)]
    return surface_cells[np.take_along_axis(index, far_neighbour[:, None], 1)[:, 0]]


class _Box(NamedTuple):
    """A labelled box.

    Attributes:
        part: part that gets its discs, 0 for an object that stands still.
        world_from_box: float64 [4, 4].
        size_m: float64 [3].
        semantic: its class.
    """

    part: int
    world_from_box: np.ndarray
    size_m: np.ndarray
    semantic: SemanticClass

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return True for points [..., 3] in the box grown by SKIN_M, bool [...]."""
        local = (points - self.world_from_box[:3, 3]) @ self.world_from_box[:3, :3]
        return (np.abs(local) <= self.size_m / 2 + SKIN_M).all(axis=-1)

    def window(self, camera: Camera) -> tuple[slice, slice] | None:
        """Return the rows and columns of the image that may show the box, or None if none does."""
        corners = _CORNERS * self.size_m @ self.world_from_box[:3, :3].T
        pose = camera.camera_from_world.numpy()
        x, y, z = ((corners + self.world_from_box[:3, 3]) @ pose[:3, :3].T + pose[:3, 3]).T
        if z.max() < _NEAREST_M or z.min() > _FURTHEST_BOX_M:
            return None
        if z.min() < _NEAREST_M:
            return slice(0, camera.height), slice(0, camera.width)
        u = camera.fx * x / z + camera.cx
        v = camera.fy * y / z + camera.cy
        left, right = np.clip([u.min(), u.max() + 1], 0, camera.width).astype(int)
        top, bottom = np.clip([v.min(), v.max() + 1], 0, camera.height).astype(int)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def _fill_box(
    box: _Box,
    cells: _Cells,
    centre: np.ndarray,
    rays: np.ndarray,
    ground_depth: np.ndarray,
    height_m: np.ndarray,
    disc_depth: np.ndarray,
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """Return the cells that show a box without a surface: their window, a mask in it, and their
    depths.

    A vehicle has no holes: below the highest of its surface in a column of cells it continues to
    the sill, as far behind the box's side as its nearest surface. Of other objects only open cells
    are closed.
    """
    no_cells = (slice(0, 0), slice(0, 0)), np.zeros((0, 0), np.bool_), np.zeros((0, 0))
    window = box.window(cells.camera)
    if window is None:
        return no_cells
    rotation = box.world_from_box[:3, :3]
    origin = (centre - box.world_from_box[:3, 3]) @ rotation
    local = rays[window] @ rotation
    local = np.where(np.abs(local) < 1e-9, 1e-9, local)
    ends = np.stack([(side * box.size_m / 2 - origin) / local for side in (-1, 1)])
    enter = ends.min(0).max(-1)
    leave = np.minimum(ends.max(0).min(-1), ground_depth[window])
    lengths = np.linalg.norm(rays[window], axis=-1)
    solid = (leave - enter) * lengths > _SOLID * min(box.size_m[:2])
    solid &= enter > _NEAREST_M
    depth = cells.depth[window]
    has_surface = cells.has_surface[window]
    holes = cells.is_open[window] & ~has_surface
    is_box_surface = has_surface & (depth > enter - _NEAR_BOX_M) & (depth < leave + _NEAR_BOX_M)
    is_box_surface &= height_m[window] > _ON_GROUND_M
    has_class = np.isin(cells.semantic[window], (box.semantic, SemanticClass.UNKNOWN))
    is_box_surface &= (cells.part[window] == box.part) & has_class
    guess = disc_depth[window]
    within = (guess >= enter) & (guess <= leave)
    guess = np.where(within, guess, enter + _SKIN * (leave - enter))
    inside = solid & holes
    if box.semantic == SemanticClass.VEHICLE and is_box_surface.sum() >= _MIN_OWN:
        columns = np.flatnonzero(is_box_surface.any(axis=0))
        top = np.interp(
            np.arange(is_box_surface.shape[1]), columns, is_box_surface.argmax(axis=0)[columns]
        )
        body = solid & (np.arange(is_box_surface.shape[0])[:, None] > top)
        body[:, : columns[0]] = body[:, columns[-1] + 1 :] = False
        body &= (ground_depth[window] - enter) * -rays[window][..., 2] > _SILL_M
        occluded = has_surface & (depth < enter - _NEAR_BOX_M)
        body &= ~is_box_surface & ~occluded
        # How far the surface lies behind the box's side: doors are as flat as that.
        recess = np.clip(
            depth - enter, 0, max(float(np.median((depth - enter)[is_box_surface])), 0)
        )
        recess = _from_nearest(recess, is_box_surface).astype(np.float32)
        smooth = cv2.blur(cv2.medianBlur(recess, 5), (_SMOOTH, _SMOOTH))
        guess = np.where(body, np.minimum(enter + smooth, leave), guess)
        inside = body
    return window, inside, guess
