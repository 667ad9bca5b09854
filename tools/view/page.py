"""One client's page: its widgets, its request, and the pictures that it shows.

A page has a ViewRequest: the recipe with its changes, the frame, the camera and all that the page
shows. Widgets change the request on the server's event loop. The viewer's thread (`server.py`)
draws the latest request and calls the page's `show_*` methods.
"""

from __future__ import annotations

import asyncio
import html
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from augment.errors import ClimateGSError
from augment.photo.trust import unfitted_cameras
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import quat_from_rotmat
from augment.scene.scene import Scene
from augment.scene.scene_times import scene_times
from recipes.errors import RecipeError
from recipes.fields import section_at
from recipes.load import describe_preset, preset_names
from recipes.schema import TIERS, Recipe
from tools.view.browser import page_style
from tools.view.controls import MAIN_FIELDS, Control, Group, effect_groups, group_of, split_by_rank
from tools.view.edits import Edits, as_yaml, create_file, hold_weather
from tools.view.fields import NONE, Field
from tools.view.pictures import (
    PICTURE,
    box_lines,
    free_camera,
    page_depth,
    picture_kinds,
    place_in_window,
)
from tools.view.status import ShownPicture, Status, page_status
from tools.view.text import STYLE, paragraph, printable
from tools.view.widgets import options_of

if TYPE_CHECKING:
    from viser import ClientHandle

    from tools.view.server import Viewer

REST_S = 0.15  # The time without a change after which the full picture is drawn, seconds.
PLAY_S = 0.1  # The time from frame to frame of a drive that is played, seconds.
# The window's camera counts as not moved within this distance of where it was put, metres.
POSE_M = 0.01
# The window's camera counts as not turned within this angle of where it was put, radians.
POSE_RAD = 0.002
ECHO_S = 30.0  # The longest time that a window gets to report where it was put, seconds.
SETTLE_S = 1.0  # The time after that report in which no flight begins, seconds.
LOOK_M = 3.0  # The distance from the camera to the point that the mouse turns it around, metres.
FRAME_S = 0.09  # The longest time for a picture while something moves, seconds.
FACTORS = (0.12, 0.5)  # The least and the largest share of the full resolution while moving.
MAX_NAME = 64  # The longest name of an uploaded file, characters.
MAX_TASKS = 8  # The most tasks of a page that may wait.
MAX_ASPECT = 8.0  # The largest ratio of a window's longer side to its shorter one.
_MAIN_NAMES = [name for names in MAIN_FIELDS.values() for name in names]
# The names of fields that are shown with their section: names that several main fields have, and
# "preset", which is also the label of the recipe's dropdown.
SHARED_NAMES = {"preset", *(name for name in _MAIN_NAMES if _MAIN_NAMES.count(name) > 1)}
BAR_FULL = 100.0  # The value of a full progress bar, percent.
_ERROR = "color:#c92a2a"  # The CSS of an error message.
# The CSS of the status line. It always has the height of two lines, so that widgets below it never
# move away from under the mouse.
_STATUS = "font-weight:bold;line-height:1.3;min-height:2.6em"
_WAITS = "color:#a35200"  # The CSS of a status line while the picture is not the one asked for.
# The CSS of a warning about the view.
_WARNING = "background:#fff3bf;color:#5c3c00;padding:0.3em 0.7em;margin-bottom:0.5em"


@dataclass(frozen=True)
class FreePose:
    """Pose of the window's camera in a flight, and its field of view."""

    wxyz: tuple[float, ...]
    """The rotation of world_from_camera as a quaternion."""
    position: tuple[float, ...]
    """The translation of world_from_camera."""
    fov_rad: float
    """The vertical field of view, radians."""


@dataclass(frozen=True)
class ViewRequest:
    """The view that a page asks for."""

    edits: Edits
    """The recipe and the changes to it."""
    frame: int
    """The position in the viewer's frames, from 0."""
    camera: str
    """The name of a recorded camera."""
    pose: FreePose | None = None
    """The pose in a flight; None for the pose of the recorded camera."""
    shows: str = PICTURE
    """The kind of the picture, one of `picture_kinds()`."""
    boxes: bool = False
    """True if labelled boxes are drawn over the picture."""
    lidar: bool = False
    """True if LiDAR returns are drawn over the picture."""
    frustums: bool = False
    """True if the frame's cameras are drawn over the picture."""
    is_split: bool = False
    """True if the left part of the picture shows the scene without weather."""
    share: float = 0.5
    """The column of the line in a split picture, as a share of the width."""
    every_pixel: bool = False
    """True if the picture has the recipe's full resolution, whatever the window's size."""
    is_playing: bool = False
    """True while the drive is played."""
    is_weather_held: bool = False
    """True if the weather is that of `weather_percent`, whatever the frame."""
    weather_percent: float = 0.0
    """The time of weather that is held, percent of the drive."""

    @property
    def needs_depth(self) -> bool:
        """True if overlays are drawn that surfaces of the picture can hide."""
        return self.boxes or self.lidar or self.frustums


@dataclass
class DrawingProgress:
    """Progress in drawing one page's requests, which are numbered from 1.

    Times are on the monotonic clock, in seconds.
    """

    request_number: int = 1
    """The number of the latest request."""
    drawn_number: int = 0
    """The number of the last request that was drawn."""
    rest_number: int = 0
    """The number of the last request that was drawn at rest, in full quality."""
    last_change_time: float = 0.0
    """The time when the latest request came, or when its drawing was given up."""
    request_time: float = field(default_factory=time.monotonic)
    """The time when the latest request came."""
    next_frame_time: float = 0.0
    """The time when a drive that is played goes to its next frame."""
    factor: float = FACTORS[1]
    """The share of the full resolution while something moves."""
    tasks: deque[Callable[[], None]] = field(default_factory=deque)
    """The tasks that wait for the viewer's thread."""


class Page:
    """One client's page.

    The viewer's thread calls the methods `show_*`. All other methods run on the server's event
    loop.
    """

    def __init__(self, viewer: Viewer, client: ClientHandle) -> None:
        self.viewer = viewer
        self.client = client
        self.gui = client.gui
        self.progress = DrawingProgress()
        self.is_closed = False
        self.request = ViewRequest(viewer.edits, 0, first_camera(viewer.scene, viewer.frames[0]))
        self.clear_picture: tuple[Any, np.ndarray] | None = (
            None  # the picture without weather, by view
        )
        self._picture: ShownPicture | None = None
        self._failed_request: ViewRequest | None = None  # could not be drawn
        self._status_lock = threading.Lock()  # three threads say what is being done
        self.groups = (*effect_groups(), group_of("camera"), group_of("render"))
        self._poses: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=30)
        self._window = (0, 0)
        self._reported_pose: FreePose | None = None  # where the window says it is
        self._quiet_until = 0.0  # the window is on its way to where it was put
        self.overlay_key: Any = None  # what is drawn over the picture
        self._overlays: dict[str, Any] = {}
        self._last_valid_recipe: Recipe | None = None
        self._recipe_result: tuple[Edits, Recipe | RecipeError] | None = None
        self._fields: dict[str, Field] = {}
        self._effects: dict[str, tuple[Any, Any]] = {}
        self._build()
        self._show_values()
        self._resize(client.camera.image_width, client.camera.image_height)
        self._move_to_recorded_camera()
        self.update_status()
        # Not before the next message: viser tells of this one too, and would say that the window is
        # where it was only just told to go.
        asyncio.get_running_loop().call_soon(client.camera.on_update, self._on_camera)

    # ---- The recipe ------------------------------------------------------------------------------

    def recipe(self, edits: Edits) -> Recipe:
        """Return the edited recipe, with numbers in place of ranges.

        Raises:
            RecipeError: the edits make no valid recipe.
        """
        result = self._recipe_result  # two threads come here
        if result is None or result[0] is not edits:
            try:
                result = (edits, edits.recipe())
            except RecipeError as error:
                result = (edits, error)
            self._recipe_result = result
        if isinstance(result[1], RecipeError):
            raise result[1]
        self._last_valid_recipe = result[1]
        return result[1]

    def recipe_at(self, request: ViewRequest, recipe: Recipe) -> Recipe:
        """Return the recipe with the weather that the page holds, or as it is.

        Raises:
            RecipeError: a timeline goes beyond the drive.
        """
        if not request.is_weather_held:
            return recipe
        drive_s = scene_times(self.viewer.scene).duration_s * request.weather_percent / 100
        return hold_weather(recipe, self.viewer.scene, self.camera_of(request), drive_s)

    @property
    def last_valid_recipe(self) -> Recipe | None:
        """The last recipe that was valid; None before the first."""
        return self._last_valid_recipe

    def camera_of(self, request: ViewRequest) -> Camera:
        """Return the camera of a request, before the recipe's scale."""
        recorded = self.recorded_camera(request)
        pose = request.pose
        if pose is None:
            return recorded
        return free_camera(recorded, pose.wxyz, pose.position, pose.fov_rad, self.aspect)

    def frame_of(self, request: ViewRequest) -> Frame:
        return self.viewer.frames[request.frame]

    def recorded_camera(self, request: ViewRequest) -> Camera:
        cameras = self.frame_of(request).cameras
        return cameras.get(request.camera) or next(iter(cameras.values()))

    @property
    def aspect(self) -> float:
        width, height = self._window
        aspect = width / height if width and height else 16 / 9
        return min(max(aspect, 1 / MAX_ASPECT), MAX_ASPECT)

    @property
    def window_height(self) -> int:
        return self._window[1] or 720

    # ---- Requests --------------------------------------------------------------------------------

    def ask(self, **changes: Any) -> None:
        """Change fields of the request. The viewer's thread draws only the latest request."""
        with self.viewer.changed:
            self.request = replace(self.request, **changes)
            self.progress.request_number += 1
            self.progress.last_change_time = self.progress.request_time = time.monotonic()
            self.viewer.changed.notify()
        self.update_status()

    def add_task(self, task: Callable[[], None]) -> None:
        """Have the viewer's thread run a task between two pictures.

        Raises:
            ClimateGSError: too many tasks wait.
        """
        if len(self.progress.tasks) >= MAX_TASKS:
            raise ClimateGSError(f"{MAX_TASKS} tasks wait to be done: press it again after them")
        with self.viewer.changed:
            self.progress.tasks.append(task)
            self.viewer.changed.notify()

    def edit(self, edits: Edits, *, show: bool = False) -> None:
        self.ask(edits=edits)
        if show:
            self._show_values()

    def _on_change(self, control: Control, text: str) -> None:
        edits = self.request.edits.with_values({control.path: text})
        if not control.nullable or text == "null":
            self.edit(edits)
            return
        section = control.path.rpartition(".")[0]
        siblings = (f for path, f in self._fields.items() if path.rpartition(".")[0] == section)
        nullable_paths = tuple(
            f.control.path for f in siblings if f.control.nullable and f.control != control
        )
        valid_edits = edits.without_conflict(control.path, nullable_paths)
        self.edit(valid_edits, show=valid_edits != edits)

    def _on_upload(self, control: Control, name: str, content: bytes) -> None:
        safe = re.sub(r"[^A-Za-z0-9._-]", "_", Path(name).name)[-MAX_NAME:].lstrip(".") or "file"
        path = create_file(self.viewer.out / "uploads", Path(safe).stem, Path(safe).suffix, content)
        relative = str(path.relative_to(self.viewer.out))
        edits = self.request.edits.with_values({control.path: as_yaml(relative)})
        controls = (control for group in self.groups for control in group.walk())
        paths = tuple(c.path for c in controls if c.nullable and c != control)
        section = control.path.rpartition(".")[0]
        nullable_paths = tuple(path for path in paths if path.rpartition(".")[0] == section)
        self.edit(edits.without_conflict(control.path, nullable_paths), show=True)

    def _on_open(self, name: str, content: bytes) -> None:
        stem = re.sub(r"[^A-Za-z0-9._-]", "_", Path(name).stem)[:MAX_NAME].lstrip(".") or "recipe"
        self._open_recipe(str(create_file(self.viewer.out / "opened", stem, ".yaml", content)))

    def _open_recipe(self, source: str) -> None:
        """Open another recipe, a preset or a file, without changes to it."""
        edits = Edits(source, self.request.edits.scale, folder=self.viewer.out)
        self.edit(edits, show=True)

    # ---- The camera ------------------------------------------------------------------------------

    def _move_to_recorded_camera(self) -> None:
        """Put the window where the recorded camera was."""
        camera = self.recorded_camera(self.request)
        pose = camera.world_from_camera.numpy()
        window_camera = self.client.camera
        position = pose[:3, 3]
        target = (position, pose[:3, :3])
        self._poses.append(target)
        pause_s = SETTLE_S if self._is_at(target) else ECHO_S
        self._quiet_until = time.monotonic() + pause_s
        with self.client.atomic():
            window_camera.position = position
            window_camera.look_at = position + LOOK_M * pose[:3, 2]
            window_camera.up_direction = -pose[:3, 1]
            window_camera.fov = place_in_window(camera, self.aspect).fov_rad

    def _end_flight(self, camera: str) -> None:
        """End a flight at a recorded camera."""
        self.ask(camera=camera, pose=None)
        self._move_to_recorded_camera()

    async def _on_camera(self, camera: Any) -> None:
        is_resized = self._resize(camera.image_width, camera.image_height)
        position = tuple(map(float, camera.position))
        wxyz = tuple(map(float, camera.wxyz))
        self._reported_pose = FreePose(wxyz, position, float(camera.fov))
        now = time.monotonic()
        if self.request.pose is None and self._is_at_recorded_camera:
            self._quiet_until = min(self._quiet_until, now + SETTLE_S)
            if is_resized:
                self._move_to_recorded_camera()
                self.ask()
        elif now < self._quiet_until:  # it may be from before, or half way
            pause_s = self._quiet_until - now
            asyncio.get_running_loop().call_later(pause_s, self._fly_where_the_window_is)
        elif self._reported_pose != self.request.pose or is_resized:
            self._fly_where_the_window_is()

    def _fly_where_the_window_is(self) -> None:
        if (
            time.monotonic() >= self._quiet_until
            and not self.is_closed
            and not self._is_at_recorded_camera
        ):
            self.ask(pose=self._reported_pose)

    @property
    def _is_at_recorded_camera(self) -> bool:
        """True if the window stands at a recorded camera where the page has lately put it."""
        return self.request.pose is None and any(map(self._is_at, self._poses))

    def _is_at(self, target: tuple[np.ndarray, np.ndarray]) -> bool:
        pose = self._reported_pose
        if pose is None:
            return False
        return _is_near(np.array(pose.wxyz), np.array(pose.position), *target)

    def _resize(self, width: int, height: int) -> bool:
        """Store the window's size. Return True if it counts as new.

        A size counts as new if its shape is new, or if it has more pixels than any before in this
        shape: a slow browser reports fewer pixels for a while.
        """
        old_width, old_height = self._window
        same_shape = abs(width * old_height - height * old_width) <= 2 * max(width, old_width)
        if same_shape and height <= old_height:
            return False
        self._window = (width, height)
        return True

    # ---- Widgets ---------------------------------------------------------------------------------

    def _build(self) -> None:
        gui = self.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()  # beside the picture
        gui.set_panel_label(printable(f"ClimateGS: {self.viewer.scene.name}"))
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0)
        self._warning = gui.add_html("", visible=False)
        self._error = gui.add_html("", visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Weather"):
            self._build_recipe()
            main_groups, other_groups = split_by_rank(self.groups[:-2])
            for group in main_groups:
                self._build_main_effect(group)
            with gui.add_folder("more effects", expand_by_default=False):
                for group in other_groups:
                    self._build_group(group)
            self._build_draws()
        with tabs.add_tab("View"):
            self._build_view()
        with tabs.add_tab("Quality"):
            self._build_quality()
            for group in self.groups[-2:]:
                self._build_group(group)
        with tabs.add_tab("Plan"):
            self._plan = gui.add_html("")
        with tabs.add_tab("Save"):
            self._build_save()
        sliders = [f.position_slider for f in self._fields.values() if f.position_slider]
        gui.add_html(page_style(sliders, [self._effects[group.path][0] for group in main_groups]))

    def _build_recipe(self) -> None:
        gui = self.gui
        names = preset_names()
        source = self.request.edits.source
        sources = options_of(names if source in names else (source, *names))
        word = next(word for word, name in sources.items() if name == source)
        hint = "A weather that comes with the package. All changes below are undone."
        preset = gui.add_dropdown("preset", tuple(sources), initial_value=word, hint=hint)
        self._about = gui.add_html("")
        upload = gui.add_upload_button("Open a recipe", mime_type=".yaml,.yml")
        undo = gui.add_button("Undo all changes")

        self._subscribe(preset, lambda word: self._open_recipe(sources[word]))
        self._subscribe(undo, lambda _: self._open_recipe(self.request.edits.source), "on_click")
        self._subscribe(upload, lambda file: self._on_open(file.name, file.content), "on_upload")

    def _build_draws(self) -> None:
        """Add the seed and the variant, which choose the draw from a recipe's ranges."""
        gui = self.gui
        with gui.add_folder("seed and variant", expand_by_default=False):
            hint = "What all random numbers follow from: drops, flakes, drifts, waves."
            self._seed = gui.add_number("seed", 0, min=0, max=2**53 - 1, step=1, hint=hint)
            hint = "Which draw from the recipe's ranges."
            self._variant = gui.add_number("variant", 0, min=0, max=2**31 - 1, step=1, hint=hint)

        self._subscribe(self._seed, lambda number: self._set("seed", int(number)))
        self._subscribe(self._variant, lambda number: self._set("variant", int(number)))

    def _set(self, path: str, value: Any) -> None:
        """Set a field whose change may also change the values of other fields."""
        self.edit(self.request.edits.with_values({path: as_yaml(value)}), show=True)

    def _build_main_effect(self, group: Group) -> None:
        """Add a switch; below it, while it is on, the main fields and a folder of all others."""
        gui = self.gui
        switch = gui.add_checkbox(group.title, False, hint=group.tooltip)
        self._subscribe(switch, lambda is_on: self._switch(group.path, is_on))
        with gui.add_folder(None, visible=False) as below:
            self._build_controls(group.main_controls, section=group.label)
            with gui.add_folder(f"more of {group.label}", expand_by_default=False):
                self._build_fields(group.secondary_group)
        self._effects[group.path] = (switch, below)

    def _build_group(self, group: Group) -> None:
        """Add a folder of fields. An effect's fields are below a switch, while it is on."""
        gui = self.gui
        with gui.add_folder(group.label, expand_by_default=False):
            if not group.optional:
                self._build_fields(group)
                return
            switch = gui.add_checkbox("on", False, hint=group.tooltip)
            self._subscribe(switch, lambda is_on: self._switch(group.path, is_on))
            with gui.add_folder(None, visible=False) as below:
                self._build_fields(group)
            self._effects[group.path] = (switch, below)

    def _build_fields(self, group: Group) -> None:
        self._build_controls(group.controls)
        for inner in group.groups:
            self._build_group(inner)

    def _build_controls(self, controls: Iterable[Control], section: str = "") -> None:
        """Add fields. section: the word before labels that are in SHARED_NAMES."""
        for control in controls:
            label = (
                f"{section}.{control.label}" if section and control.label in SHARED_NAMES else None
            )
            self._fields[control.path] = Field(
                self.gui, control, self._subscribe, self._on_change, self._on_upload, label=label
            )

    def _switch(self, section: str, is_on: bool) -> None:
        edits = self.request.edits
        change = edits.with_section if is_on else edits.without_section
        self.edit(change(section), show=True)

    def _build_view(self) -> None:
        gui = self.gui
        frames = self.viewer.frames
        last = max(len(frames) - 1, 1)
        hint = "Which frame of the drive, counted from 0."
        self._time = gui.add_slider("frame", 0, last, 1, 0, hint=hint, disabled=len(frames) == 1)
        play = gui.add_checkbox("play", False)
        cameras = options_of(self.viewer.scene.camera_names)
        word = next(word for word, name in cameras.items() if name == self.request.camera)
        camera = gui.add_dropdown("camera", tuple(cameras), initial_value=word)
        back = gui.add_button("Back to the camera")
        shows = gui.add_dropdown("shows", picture_kinds())
        gui.add_html(
            paragraph(
                "Fly: drag to turn, right drag to move, wheel to go ahead; W A S D, Q E and the "
                "arrow keys."
            )
        )

        self._subscribe(self._time, self.go_to_frame)
        self._subscribe(camera, lambda word: self._end_flight(cameras[word]))
        self._subscribe(back, lambda _: self._end_flight(self.request.camera), "on_click")
        with gui.add_folder("time of the weather", expand_by_default=False):
            hint = "Weather that changes is that of the time below, and not of the frame."
            self._toggle("hold", "is_weather_held", hint)
            hint = "From the drive's first image to its last, percent of the time between."
            percent = gui.add_slider("at [%]", 0.0, 100.0, 0.5, 0.0, hint=hint)
        with gui.add_folder("before and after"):
            self._toggle("split", "is_split", "Left of the line the scene without its weather.")
            line = gui.add_slider("line", 0.0, 1.0, 0.005, self.request.share)
        with gui.add_folder("drawn over the picture"):
            self._toggle("boxes", "boxes", "Labelled boxes of the frame.")
            hint = "The sweep as the weather leaves it. Cyan: unchanged; yellow: attenuated; "
            self._toggle(
                "LiDAR", "lidar", hint + "red: scattered; magenta: moved; white: drops, flakes."
            )
            self._toggle("cameras", "frustums", "The frame's cameras.")
        hint = "Draw what `climategs render` writes, though the window shows less."
        self._toggle("every pixel", "every_pixel", hint)
        self._bind(play, "is_playing")
        self._bind(shows, "shows")
        self._bind(line, "share")
        self._bind(percent, "weather_percent")

    def _toggle(self, label: str, name: str, hint: str) -> None:
        self._bind(self.gui.add_checkbox(label, False, hint=hint), name)

    def _bind(self, part: Any, name: str) -> None:
        self._subscribe(part, lambda value: self.ask(**{name: value}))

    def _subscribe(self, part: Any, act: Callable[[Any], None], kind: str = "on_update") -> None:
        """Call `act` with each value that people give a widget. The page shows what it raises.

        Args:
            part: viser's handle of the widget.
            act: A function of the widget's value.
            kind: The name of viser's method that takes a listener.
        """

        async def on_event(event: Any) -> None:
            if event.client is None:  # not people, but `_show_values`
                return
            try:
                act(event.target.value)
            except Exception as error:
                self.viewer.report(self, error)

        getattr(part, kind)(on_event)

    def _build_quality(self) -> None:
        gui = self.gui
        hint = "Settings of all that trades speed for accuracy and that the recipe does not give."
        self._tier = gui.add_dropdown("tier", (NONE, *TIERS, "reference"), hint=hint)
        measure = gui.add_button("Measure the tiers on this view")
        self._tiers = gui.add_html("")

        self._subscribe(self._tier, self._choose_tier)
        self._subscribe(measure, lambda _: self._measure(), "on_click")

    def _choose_tier(self, word: str) -> None:
        self.edit(self.request.edits.with_tier(None if word == NONE else word), show=True)

    def _measure(self) -> None:
        self._add_reported_task(self._tiers, "measuring", lambda: self.viewer.measure_tiers(self))

    def _build_save(self) -> None:
        gui = self.gui
        self._name = gui.add_text("name", "my-weather", hint="Of the recipe and of its files.")
        recipe = gui.add_button("Save recipe")
        picture = gui.add_button("Save picture")
        gui.add_html(paragraph(f"Into the folder {self.viewer.out}. Nothing is replaced."))
        self._save_report = gui.add_html("")
        self._command = gui.add_html("")

        self._subscribe(recipe, lambda _: self._save(with_picture=False), "on_click")
        self._subscribe(picture, lambda _: self._save(with_picture=True), "on_click")

    def _save(self, *, with_picture: bool) -> None:
        name = self._name.value
        self._add_reported_task(
            self._save_report,
            "saving",
            lambda: self.viewer.save(self, name, with_picture=with_picture),
        )

    def _add_reported_task(self, part: Any, word: str, task: Callable[[], None]) -> None:
        """Have the viewer's thread run a task. A widget shows a word until the task is done.

        Args:
            part: viser's handle of the widget.
            word: The word.
            task: The task; on success it shows its result in the widget.
        """

        def act() -> None:
            try:
                task()
            except Exception:
                part.content = ""
                raise

        part.content = paragraph(word)
        self.add_task(act)

    def go_to_frame(self, number: int) -> None:
        self.ask(frame=min(number, len(self.viewer.frames) - 1))
        if self.request.pose is None:
            self._move_to_recorded_camera()

    def _show_values(self) -> None:
        """Set all widgets to the recipe's values."""
        try:
            recipe = self.recipe(self.request.edits)
        except RecipeError as error:
            self.show_error(str(error))
            return
        for path, (switch, below) in self._effects.items():
            switch.value = below.visible = section_at(recipe, path) is not None
        for path, recipe_field in self._fields.items():
            if section_at(recipe, path.rpartition(".")[0]) is not None:
                recipe_field.show(section_at(recipe, path))
        source = self.request.edits.source
        about = describe_preset(source) if source in preset_names() else "Your recipe."
        if recipe.timelines:
            paths = ", ".join(timeline.path for timeline in recipe.timelines)
            about += (
                f" Changes over time: {paths}. A change of such a field here gives it one value."
            )
        self._about.content = paragraph(about, style="padding-bottom:0.6em")
        self._seed.value = min(recipe.seed, 2**53 - 1)
        self._variant.value = recipe.variant
        self._tier.value = recipe.quality.tier or NONE

    # ---- Called by the viewer's thread -----------------------------------------------------------

    def show_progress(self, picture: ShownPicture) -> None:
        """Store a picture that was sent, and update the status line."""
        self._picture = picture
        self._failed_request = None
        self.update_status()

    def show_failure(self, request: ViewRequest) -> None:
        """Store a request that could not be drawn, and update the status line."""
        self._failed_request = request
        self.update_status()

    def update_status(self) -> None:
        """Update the status line: the picture, and the work for the next one.

        Any thread may call it.
        """
        if self.is_closed:
            return
        with self._status_lock:
            now = time.monotonic()
            request = self.request
            status = page_status(
                self._picture,
                request,
                self.viewer.activity_for(self),
                waited_s=now - self.progress.request_time,
                now=now,
                has_failed=self._failed_request is request,
            )
            color = "" if status.is_current else _WAITS
            content = paragraph(status.text, style=f"{_STATUS};{color}")
            if self._status.content != content:
                self._status.content = content
            self._show_bar(status)

    def _show_bar(self, status: Status) -> None:
        """Show the finished share as a bar. If the share is not known, the bar only moves."""
        is_known = status.share is not None or not status.is_long
        value = round(BAR_FULL * (status.share or 0.0), 1) if is_known else BAR_FULL
        if self._bar.value != value:
            self._bar.value = value
        if self._bar.animated == is_known:
            self._bar.animated = not is_known

    def show_warning(self, text: str | None) -> None:
        """Show a warning about the view; None removes it."""
        content = "" if text is None else paragraph(text, style=_WARNING)
        if self._warning.content != content:
            self._warning.content = content
            self._warning.visible = text is not None

    def show_error(self, text: str | None) -> None:
        """Show an error; None removes it."""
        if text is None and not self._error.visible:
            return
        self._error.content = paragraph(text or "", style=_ERROR)
        self._error.visible = text is not None

    def show_plan(self, content: str) -> None:
        """Show the table of the plan, as HTML."""
        if self._plan.content != content:
            self._plan.content = content

    def show_tiers(self, content: str) -> None:
        """Show the table of the tiers, as HTML."""
        self._tiers.content = content

    def show_saved(self, text: str, command: str) -> None:
        """Show the names of saved files, and the command line that renders them."""
        self._save_report.content = paragraph(text)
        self.show_command(command)

    def show_command(self, command: str) -> None:
        """Show a command line with a button that copies it."""
        content = (
            f'<div style="{STYLE}">'
            '<textarea readonly rows="6" style="width:100%;font:11px monospace">'
            f"{html.escape(printable(command))}</textarea>"
            '<button onclick="navigator.clipboard.writeText(this.previousElementSibling.value)">'
            "Copy command</button></div>"
        )
        if self._command.content != content:
            self._command.content = content

    def show_picture(self, rgb: np.ndarray, depth_m: np.ndarray | None, *, moving: bool) -> None:
        """Send a picture, as PNG at rest and as JPEG while something moves.

        Args:
            rgb: [H, W, 3], uint8.
            depth_m: [H, W], metres, 0 where there is no surface; None without overlays.
            moving: True while something moves.
        """
        depth = None if depth_m is None else page_depth(depth_m)
        kind = "jpeg" if moving else "png"
        self.client.scene.set_background_image(rgb, kind, jpeg_quality=80, depth=depth)

    def show_overlays(
        self, request: ViewRequest, points: tuple[np.ndarray, np.ndarray] | None
    ) -> None:
        """Draw the boxes, cameras and LiDAR returns of a request over the picture.

        Args:
            request: The request.
            points: Points and colours of LiDAR returns, from `lidar_points`; None for none.
        """
        scene = self.viewer.scene
        frame = self.frame_of(request)
        for handle in self._overlays.values():
            handle.remove()
        self._overlays = {}
        api = self.client.scene
        if request.boxes:
            lines, colors = box_lines(scene, frame)
            if len(lines):
                self._overlays["boxes"] = api.add_line_segments(
                    "/boxes", lines, colors, thickness=2.0, thickness_units="screen"
                )
        if points is not None:
            self._overlays["lidar"] = api.add_point_cloud(
                "/lidar", *points, point_size=0.02, precision="float32", point_shading="flat"
            )
        for name, camera in frame.cameras.items() if request.frustums else ():
            if request.pose is None and camera is self.recorded_camera(request):
                continue  # the window looks out of it
            pose = camera.world_from_camera
            self._overlays[name] = api.add_camera_frustum(
                f"/cameras/{printable(name)}",
                fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
                aspect=camera.width / camera.height,
                scale=0.5,
                thickness=0.01,
                color=(255, 160, 0),
                wxyz=quat_from_rotmat(pose[:3, :3]).numpy(),
                position=pose[:3, 3].numpy(),
            )

    def advance(self) -> None:
        """Go to the next frame of a drive that is played."""
        number = (self.request.frame + 1) % len(self.viewer.frames)
        self._time.value = number
        self.go_to_frame(number)


def first_camera(scene: Scene, frame: Frame) -> str:
    """Return the name of a camera that looks ahead.

    Cameras whose images the scene was made from come first.
    """
    unfitted_names = unfitted_cameras(scene)
    names = [name for name in frame.cameras if name not in unfitted_names] or list(frame.cameras)
    return min(names, key=lambda name: ("front" not in name, len(name)))


def _is_near(
    wxyz: np.ndarray, position: np.ndarray, target_position: np.ndarray, target_rotation: np.ndarray
) -> bool:
    """Return True if a pose is within POSE_M and POSE_RAD of a target."""
    w, x, y, z = wxyz
    ahead = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    turn_rad = float(np.linalg.norm(ahead - target_rotation[:, 2]))
    return float(np.linalg.norm(position - target_position)) < POSE_M and turn_rad < POSE_RAD
