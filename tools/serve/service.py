"""The methods of the sensor service: from the bytes of a request to the bytes of its response.

Every request is parsed, counted and logged here, and every error becomes a gRPC status with a
sentence. Drawing is left to `DrawingThreads`, scenes to `SceneStore`.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import grpc
import numpy as np
from google.protobuf.message import DecodeError

import augment
from augment.errors import ClimateGSError
from augment.files.recorded_images import ImageFault, read_scaled
from augment.photo.own_car import own_car_mask
from augment.render.threads import wait_for_result
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.errors import RecipeError
from recipes.schema import Recipe
from tools.serve.actors import RequestedScene, requested_scene
from tools.serve.cameras import available_camera, has_same_intrinsics, image_size, requested_camera
from tools.serve.drawing import DrawingThreads, check_format, encode_for
from tools.serve.errors import RequestEnded, RequestRefused, invalid, quote_text
from tools.serve.lidar import requested_sweep
from tools.serve.messages import (
    INTERFACE_VERSION,
    MAX_MESSAGE_BYTES,
    Method,
    message_class,
    methods,
    service_names,
)
from tools.serve.metrics import Metrics
from tools.serve.poses import pose_message
from tools.serve.scene_facts import SceneFacts
from tools.serve.scene_store import OpenScene, SceneStore, scene_name

Item = TypeVar("Item")
_LOG = logging.getLogger(__name__)
# Pixels of all images of a batch, at most: as many as a message can hold without compression.
MAX_BATCH_PIXELS = MAX_MESSAGE_BYTES // 3
# Images of a batch, at most.
MAX_BATCH_IMAGES = 64
# Length of an error's text, at most, characters: gRPC sends it in a header.
_MAX_TEXT_LENGTH = 1500
# Methods that take long, of which a limited number is in flight.
_LONG_METHODS = ("render_rgb", "render_lidar", "render_aggregated", "batch_render_rgb")


class Call:
    """A request in flight.

    Args:
        context: gRPC's context of the request.
    """

    def __init__(self, context: Any) -> None:
        self._context = context
        self.subjects: list[str] = []
        """Scenes and cameras that the request names, for the log."""
        self.moved_scenes: dict[bytes, RequestedScene] = {}
        """The scene in use by its moving objects: images of one step have the same."""

    def check(self) -> None:
        """Raise RequestEnded if nobody waits for the response any more."""
        if not self._context.is_active():
            raise RequestEnded(
                grpc.StatusCode.CANCELLED, "the client has cancelled the request, or is gone"
            )
        remaining_s = self._context.time_remaining()
        if remaining_s is not None and remaining_s <= 0:
            raise RequestEnded(
                grpc.StatusCode.DEADLINE_EXCEEDED, "the deadline of the request has passed"
            )


@dataclass(frozen=True)
class Limits:
    """Limits of what clients may ask for."""

    max_pixels: int
    """Pixels of an image, at most."""
    max_requests: int
    """Requests for images and sweeps in flight, at most."""


@dataclass(frozen=True, eq=False)
class _PendingImage:
    """An image that is being drawn."""

    request: Any
    """Its `RGBRenderRequest`."""
    opened: OpenScene
    """Its scene."""
    recipe: Recipe
    """Its weather."""
    camera: Camera
    """Its camera."""
    finish: Callable[[], Any]
    """Function that waits for the view."""


class SensorService:
    """The service's methods.

    Args:
        store: the scenes.
        threads: the threads that draw.
        limits: limits of what clients may ask for.
        metrics: figures that requests are counted in.
        log: called with a line for each request; None for no log.
    """

    def __init__(
        self,
        store: SceneStore,
        threads: DrawingThreads,
        limits: Limits,
        metrics: Metrics,
        log: Callable[[str], None] | None = None,
    ) -> None:
        self._store = store
        self._threads = threads
        self._limits = limits
        self._metrics = metrics
        self._log = log
        self._noting = threading.Lock()
        self._noted_scenes: set[str] = set()
        self._places = threading.BoundedSemaphore(limits.max_requests)
        self._answers: dict[str, Callable[[Any, Call], Any]] = {
            "render_rgb": self._render_rgb,
            "render_lidar": self._render_lidar,
            "render_aggregated": self._render_aggregated,
            "batch_render_rgb": self._batch_render_rgb,
            "get_version": self._get_version,
            "get_available_scenes": self._get_available_scenes,
            "get_available_cameras": self._get_available_cameras,
            "get_available_trajectories": self._get_available_trajectories,
            "get_available_ego_masks": self._get_available_ego_masks,
        }

    def handlers(self) -> list[Any]:
        """Return gRPC's handlers of all methods, under both names of the service."""
        handler_by_name = {
            method.name: grpc.unary_unary_rpc_method_handler(self._handler(method))
            for method in methods()
        }
        return [
            grpc.method_handlers_generic_handler(name, handler_by_name) for name in service_names()
        ]

    # ---- From bytes to bytes ---------------------------------------------------------------------

    def _handler(self, method: Method) -> Callable[[bytes, Any], bytes]:
        """Return the function that gRPC calls for a method."""

        def handle(data: bytes, context: Any) -> bytes:
            start_s = time.perf_counter()
            self._metrics.begin()
            call = Call(context)
            code = grpc.StatusCode.OK
            text = ""
            response = b""
            try:
                response = self._respond(method, data, call)
            except (RequestRefused, RequestEnded) as error:
                code = error.code
                text = str(error)
            except (ClimateGSError, RecipeError) as error:
                code = grpc.StatusCode.FAILED_PRECONDITION
                text = str(error)
            except MemoryError:
                code = grpc.StatusCode.RESOURCE_EXHAUSTED
                text = "memory ran out; ask for smaller images, or for fewer at a time"
            except Exception as error:
                code = grpc.StatusCode.INTERNAL
                text = f"a defect of the server, whose log says more: {type(error).__name__}"
                _LOG.error("%s", "".join(traceback.format_exception(error)))
            seconds = time.perf_counter() - start_s
            self._metrics.end(method.name, code.name, seconds)
            if self._log is not None:
                self._log(_log_line(context, method, call, code, text, seconds))
            if code is not grpc.StatusCode.OK:
                context.abort(code, text[:_MAX_TEXT_LENGTH])
            return response

        return handle

    def _respond(self, method: Method, data: bytes, call: Call) -> bytes:
        """Return the bytes of the response to the bytes of a request."""
        try:
            request = method.request_class.FromString(data)
        except DecodeError as error:
            raise invalid(
                f"the {len(data)} bytes of this request are not a message "
                f"{method.request_class.DESCRIPTOR.name}"
            ) from error
        is_long = method.name in _LONG_METHODS
        if is_long and not self._places.acquire(blocking=False):
            raise RequestRefused(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"{self._limits.max_requests} requests are in flight already (--max-requests): "
                f"wait for some of them, and try again",
            )
        try:
            response = self._answers[method.name](request, call).SerializeToString()
        finally:
            if is_long:
                self._places.release()
        if len(response) > MAX_MESSAGE_BYTES:
            raise RequestRefused(
                grpc.StatusCode.RESOURCE_EXHAUSTED,
                f"the response has {len(response)} bytes; a message may have {MAX_MESSAGE_BYTES}: "
                f"ask for fewer images at a time, or for JPEG",
            )
        return response

    # ---- Images ----------------------------------------------------------------------------------

    def _render_rgb(self, request: Any, call: Call) -> Any:
        with contextlib.ExitStack() as stack:
            return self._finish_image(self._begin_image(request, call, stack))

    def _batch_render_rgb(self, request: Any, call: Call) -> Any:
        items = request.items
        _check_batch([item.request for item in items])
        item_class = message_class("BatchRGBRenderReturnItem")
        response = message_class("BatchRGBRenderReturn")()
        for run in _runs_of_scenes(items, lambda item: item.request):
            call.moved_scenes.clear()
            with contextlib.ExitStack() as stack:
                begun_images = [self._try_to_begin(item.request, call, stack) for item in run]
                for item, begun in zip(run, begun_images, strict=True):
                    answer = item_class(camera_name=item.camera_name)
                    try:
                        if isinstance(begun, Exception):
                            raise begun
                        answer.result.CopyFrom(self._finish_image(begun))
                        answer.success = True
                    except (ClimateGSError, RecipeError) as error:
                        answer.error_message = str(error)[:_MAX_TEXT_LENGTH]
                    response.items.append(answer)
        return response

    def _render_aggregated(self, request: Any, call: Call) -> Any:
        _check_batch(request.rgb_requests)
        if len(request.lidar_requests) > MAX_BATCH_IMAGES:
            raise invalid(f"a request may ask for {MAX_BATCH_IMAGES} sweeps, at most")
        response = message_class("AggregatedRenderReturn")()
        for run in _runs_of_scenes(request.rgb_requests, lambda rgb: rgb):
            call.moved_scenes.clear()
            with contextlib.ExitStack() as stack:
                pending = [self._begin_image(rgb, call, stack) for rgb in run]
                response.rgb_returns.extend(map(self._finish_image, pending))
        response.lidar_returns.extend(
            self._render_lidar(lidar, call) for lidar in request.lidar_requests
        )
        return response

    def _try_to_begin(
        self, request: Any, call: Call, stack: contextlib.ExitStack
    ) -> _PendingImage | Exception:
        """Return an image that was begun, or the reason why it cannot be drawn."""
        try:
            return self._begin_image(request, call, stack)
        except (ClimateGSError, RecipeError) as error:
            return error

    def _begin_image(self, request: Any, call: Call, stack: contextlib.ExitStack) -> _PendingImage:
        """Begin the image of an `RGBRenderRequest`; its scene stays open until the stack closes."""
        call.check()
        check_format(request)
        facts = self._store.facts(request.scene_id)
        camera = requested_camera(request, facts, self._limits.max_pixels)
        size = f"{camera.width}x{camera.height}"
        call.subjects.append(f"{request.scene_id} {quote_text(camera.name)} {size}")
        if request.insert_ego_mask:
            _check_ego_mask(request, facts, camera)
        opened, recipe = stack.enter_context(self._store.borrow(request.scene_id, call.check))
        scene = self._moved_scene(request, opened, call)
        finish = self._threads.begin_view(scene, camera, recipe, opened.backend, call.check)
        return _PendingImage(request, opened, recipe, camera, finish)

    def _moved_scene(self, request: Any, opened: OpenScene, call: Call) -> Scene:
        """Return the scene with its actors where the request says."""
        if not request.dynamic_objects:
            return opened.scene
        key_message = message_class("RGBRenderRequest")(
            frame_start_us=request.frame_start_us,
            frame_end_us=request.frame_end_us,
            dynamic_objects=request.dynamic_objects,
        )
        key = key_message.SerializeToString(deterministic=True)
        moved = call.moved_scenes.get(key)
        if moved is None:
            moved = call.moved_scenes[key] = requested_scene(request, opened.scene)
            self._note_unknown_tracks(opened.facts.name, moved.unknown_tracks)
        return moved.scene

    def _note_unknown_tracks(self, scene_name: str, track_ids: Sequence[str]) -> None:
        """Warn of tracks that a scene does not have, once for each scene."""
        with self._noting:
            if not track_ids or scene_name in self._noted_scenes:
                return
            self._noted_scenes.add(scene_name)
        listed = ", ".join(quote_text(track_id) for track_id in track_ids[:8])
        _LOG.warning(
            "scene %s does not have %d of the moving objects of a request, such as %s: they are "
            "left out, here and in later requests",
            scene_name,
            len(track_ids),
            listed,
        )

    def _finish_image(self, pending: _PendingImage) -> Any:
        """Return the `RGBRenderReturn` of an image that was begun."""
        rgb = pending.finish().rgb
        if pending.request.insert_ego_mask:
            rgb = _with_ego_mask(rgb, pending.opened.scene, pending.camera, pending.recipe)
        data = encode_for(pending.request, rgb, pending.recipe)
        self._metrics.add_image()
        return message_class("RGBRenderReturn")(image_bytes=data)

    # ---- LiDAR -----------------------------------------------------------------------------------

    def _render_lidar(self, request: Any, call: Call) -> Any:
        call.check()
        facts = self._named_facts(request, call)
        with self._store.borrow(request.scene_id, call.check) as (opened, recipe):
            work = self._threads.submit(
                lambda: requested_sweep(request, opened.scene, recipe, facts)
            )
            return wait_for_result(work)

    # ---- Facts -----------------------------------------------------------------------------------

    def _named_facts(self, request: Any, call: Call) -> SceneFacts:
        """Return the facts of a request's scene, whose name is noted for the log.

        An unknown name is in the refusal, shortened: the log gets no text of any length.
        """
        facts = self._store.facts(request.scene_id)
        call.subjects.append(request.scene_id)
        return facts

    def _get_version(self, request: Any, call: Call) -> Any:
        version_class = message_class("common.VersionId")
        major, minor, patch = INTERFACE_VERSION
        return version_class(
            version_id=f"climategs {augment.__version__}",
            grpc_api_version=version_class.APIVersion(major=major, minor=minor, patch=patch),
        )

    def _get_available_scenes(self, request: Any, call: Call) -> Any:
        return message_class("common.AvailableScenesReturn")(scene_ids=self._store.scene_ids)

    def _get_available_cameras(self, request: Any, call: Call) -> Any:
        facts = self._named_facts(request, call)
        cameras = [available_camera(camera) for camera in facts.cameras]
        return message_class("AvailableCamerasReturn")(available_cameras=cameras)

    def _get_available_trajectories(self, request: Any, call: Call) -> Any:
        facts = self._named_facts(request, call)
        response = message_class("AvailableTrajectoriesReturn")()
        trajectory = response.available_trajectories.add().trajectory
        for timestamp_us, world_from_rig in facts.path:
            trajectory.poses.add(pose=pose_message(world_from_rig), timestamp_us=timestamp_us)
        return response

    def _get_available_ego_masks(self, request: Any, call: Call) -> Any:
        response = message_class("AvailableEgoMasksReturn")()
        for facts in self._store.all_facts:
            for name in facts.masked_cameras:
                mask_id = response.ego_mask_metadata.add().ego_mask_id
                mask_id.camera_logical_id = name
                mask_id.rig_config_id = facts.name
        return response


def _runs_of_scenes(items: Iterable[Item], request_of: Callable[[Item], Any]) -> list[list[Item]]:
    """Return images that follow each other in runs of one scene, which are drawn together.

    The scene of a run is free before that of the next one is borrowed: requests that hold a scene
    while they wait for another would wait for each other, where few scenes are open.

    Args:
        items: the images.
        request_of: returns the `RGBRenderRequest` of an image.
    """
    runs = itertools.groupby(items, key=lambda item: scene_name(request_of(item).scene_id))
    return [list(run) for _, run in runs]


def _check_batch(requests: Any) -> None:
    """Refuse a batch whose images are too many, or too large together."""
    if len(requests) > MAX_BATCH_IMAGES:
        raise invalid(
            f"a request may ask for {MAX_BATCH_IMAGES} images, at most; got {len(requests)}"
        )
    num_pixels = sum(math.prod(image_size(request)) for request in requests)
    if num_pixels > MAX_BATCH_PIXELS:
        raise invalid(
            f"the images of a request may have {MAX_BATCH_PIXELS} pixels together, at most; got "
            f"{num_pixels}"
        )


# ---- The recording car ---------------------------------------------------------------------------


def _check_ego_mask(request: Any, facts: SceneFacts, camera: Camera) -> None:
    """Refuse a mask of the recording car that the scene does not have."""
    mask_id = request.ego_mask_id
    names = facts.masked_cameras
    if mask_id.rig_config_id == facts.name and mask_id.camera_logical_id in names:
        if mask_id.camera_logical_id != camera.name:
            raise invalid(
                f"ego_mask_id names camera {quote_text(mask_id.camera_logical_id)}, and the image "
                f"is of camera {quote_text(camera.name)}"
            )
        recorded = next(c.camera for c in facts.cameras if c.camera.name == camera.name)
        if not has_same_intrinsics(camera, recorded.resized(camera.width, camera.height)):
            raise invalid(
                f"the mask of the recording car is known through the recorded lens of camera "
                f"{camera.name!r} only: ask for it with the camera_intrinsics of "
                f"get_available_cameras"
            )
        return
    camera_names = ", ".join(names) or "no camera"
    raise RequestRefused(
        grpc.StatusCode.NOT_FOUND,
        f"scene {facts.name!r} has no mask of camera {quote_text(mask_id.camera_logical_id)} and "
        f"rig {quote_text(mask_id.rig_config_id)}; rig {facts.name!r} has masks of {camera_names} "
        f"(they are those of ego_masks=FOLDER in the scene's URI)",
    )


def _with_ego_mask(rgb: np.ndarray, scene: Scene, camera: Camera, recipe: Recipe) -> np.ndarray:
    """Return an image with the recording car in front of it.

    The car's pixels are those of the recorded image nearest in time. They are black where there is
    no such image, and at night, when nothing shows the car.

    Args:
        rgb: uint8 [H, W, 3].
        scene: the scene, which has a mask for the camera.
        camera: the camera of the image.
        recipe: the weather.
    """
    mask = own_car_mask(scene, camera)
    if mask is None:
        return rgb
    photo = np.zeros_like(rgb)
    frames = [frame for frame in scene.frames if camera.name in frame.image_paths]
    if frames and recipe.light is None:
        frame = min(frames, key=lambda frame: abs(frame.timestamp_ns - camera.timestamp_ns))
        recorded = frame.cameras[camera.name]
        with contextlib.suppress(ImageFault):
            path = Path(frame.image_paths[camera.name])
            photo = read_scaled(path, recorded, recorded.resized(camera.width, camera.height))
    return np.where(mask[..., None], photo, rgb)


# ---- The log -------------------------------------------------------------------------------------


def _log_line(
    context: Any, method: Method, call: Call, code: grpc.StatusCode, text: str, seconds: float
) -> str:
    """Return the line of a request that has ended."""
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    subjects = "; ".join(call.subjects[:8])
    words = [
        now,
        context.peer(),
        method.name,
        subjects,
        code.name,
        f"{1000 * seconds:.0f} ms",
        text,
    ]
    line = " ".join(word for word in words if word)
    return "".join(character if character.isprintable() else "?" for character in line)
