"""The server of `climategs view`: it serves pages, and one thread draws for all of them.

The thread draws the latest request of each page; pages on which something moves come first. While
a camera or a slider moves, pictures are small and rough. At rest the picture is the one that
`climategs render` writes. A page that is slow to take pictures delays only its own connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import logging
import math
import shlex
import socket
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

import cv2
import numpy as np

from adapters.base import open_scene
from adapters.camera_files.paths import frames_from_path_file
from augment.errors import ClimateGSError
from augment.output.atomic import write_new_file
from augment.output.codecs import encode_image
from augment.render.backends import choose_backend
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from augment.scene.scene_index import check_frames
from augment.timing import PassProgress, stopwatch, watched
from augment.view.plan import check_plans, plan_at, plan_view
from augment.view.render_view import render_view
from recipes.errors import RecipeError, short
from recipes.schema import TIERS, Recipe
from tools.output import compiling_noted, print_note
from tools.view.access import TOKEN_FIELD, Access, is_loopback, start_server
from tools.view.browser import ARROWS_STAY_WITH_WIDGETS
from tools.view.edits import Edits, rename_recipe, save_recipe, unused_path, without_weather
from tools.view.outputs import OutputViewer, find_output
from tools.view.page import FACTORS, FRAME_S, PLAY_S, REST_S, Page, ViewRequest
from tools.view.pictures import (
    PageImage,
    add_window_bars,
    coarse_recipe,
    distance_warning,
    draw,
    lidar_points,
    place_in_window,
    recipe_to_show,
    split_pictures,
)
from tools.view.status import Activity, ShownPicture
from tools.view.text import table
from tools.warm_up import kernel_modules

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

    from tools.cli import ViewOptions

_LOG = logging.getLogger(__name__)
EVERY_ADDRESS = ("0.0.0.0", "::", "")  # The hosts that mean all addresses of this machine.
# The most pixels of a picture that is drawn for a page: as many as 8K video has.
MAX_PIXELS = 2**25
JOIN_S = 10.0  # The time that the picture at hand gets when the server ends, seconds.
TICK_S = 0.25  # The time between two updates of the pages' status lines, seconds.


def view_scene(options: ViewOptions) -> int:
    """Serve pages until the user interrupts. Return the exit code."""
    viser = import_viser()
    if (output := find_output(options.scene)) is not None:
        return _serve_until_interrupted(viser, OutputViewer(output), options)
    scene = open_scene(options.scene)
    check_frames(scene)
    overrides = (text.partition("=") for text in options.overrides)
    values = {path.strip(): value for path, _, value in overrides}
    edits = Edits(options.recipe, options.scale, values, folder=options.out)
    check_plans(edits.recipe(), scene)  # refuse before a page opens
    backend = choose_backend(options.backend, scene)
    viewer = Viewer(scene, options.scene, edits, options.out, backend)
    return _serve_until_interrupted(viser, viewer, options)


def _serve_until_interrupted(viser: Any, viewer: Pages, options: ViewOptions) -> int:
    with serve(viser, viewer, options.host, options.port) as url:
        print(f"{options.scene}: {url}   (Ctrl-C ends it)", flush=True)
        if not is_loopback(options.host):
            port = urlsplit(url).port
            elsewhere = (
                "; on other machines, open it with this one's name in place of localhost"
                if options.host in EVERY_ADDRESS
                else ""
            )
            print_note(
                f"note: whoever has this address, with its token, sees what is shown here and can "
                f"have files written to {options.out}{elsewhere}. It goes over the network "
                f"unencrypted: where others can listen, serve at 127.0.0.1 and use "
                f"`ssh -L {port}:localhost:{port}`"
            )
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    return 0


class Pages(Protocol):
    """A set of pages that a server shows."""

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def open_page(self, client: ClientHandle) -> Callable[[str], None]:
        """Open a client's page. Return the function that shows on it what the server refused."""
        ...

    def close_page(self, client: ClientHandle) -> None: ...


def import_viser() -> Any:
    """Return the module viser.

    Raises:
        ClimateGSError: viser is not installed.
    """
    try:
        with warnings.catch_warnings():  # of what it imports
            warnings.simplefilter("ignore")
            import viser
    except ModuleNotFoundError as error:
        raise ClimateGSError(
            f"climategs view needs viser, which is not installed ({error}): "
            f"pip install 'climategs[view]'"
        ) from error
    return viser


@contextlib.contextmanager
def serve(viser: Any, viewer: Pages, host: str, port: int) -> Iterator[str]:
    """Serve pages while the block runs. The block gets the pages' URL with its token.

    Args:
        viser: The module viser.
        viewer: The pages.
        host: An address of this machine.
        port: The port; the next free one is taken if it is in use.

    Raises:
        ClimateGSError: this machine does not have the address.
    """
    from tools.view.messages import MAX_MESSAGE_BYTES, PageConnection  # has viser's libraries

    try:
        family, _, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(address)
    except OSError as error:
        raise ClimateGSError(
            f"--host {host}: no address of this machine ({error}); 127.0.0.1 is for browsers on "
            f"it, 0.0.0.0 for all that reach it"
        ) from error
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    access = Access(is_local=is_loopback(str(address[0])))
    options = {"create_connection": PageConnection, "max_size": MAX_MESSAGE_BYTES}
    script = ARROWS_STAY_WITH_WIDGETS
    with contextlib.redirect_stdout(io.StringIO()):  # it says what we say
        server = start_server(viser, access, host, port, script=script, **options)
    server.gui.configure_theme(show_logo=False, show_share_button=False)  # before a page is there
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, _note_exception)
    viewer.start()

    @server.on_client_connect
    async def _(client: ClientHandle) -> None:
        connection = server._websock_server._live_connections[client.client_id]
        try:
            connection.report = viewer.open_page(client)
            connection.widget_of = client.gui._gui_input_handle_from_uuid.get
        except Exception as error:
            _LOG.error("%s", "".join(traceback.format_exception(error)))
            await connection.close(1011, "the page cannot be made; the server's log says why")

    @server.on_client_disconnect
    async def _(client: ClientHandle) -> None:
        viewer.close_page(client)

    name = "localhost" if is_loopback(host) or host in EVERY_ADDRESS else host
    name = f"[{name}]" if ":" in name else name
    try:
        yield f"http://{name}:{server.get_port()}/?{TOKEN_FIELD}={access.token}"
    finally:
        viewer.stop()
        _stop(server)


def _note_exception(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log in one line that a message of a page ended in an exception.

    viser casts the values of widgets before anything checks them.
    """
    error = context.get("exception")
    if error is None:
        loop.default_exception_handler(context)
        return
    _LOG.warning(
        "a message of a page is passed over: %s: %s", type(error).__name__, short(str(error))
    )
    _LOG.debug("it came from here", exc_info=error)


def _stop(server: ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class Viewer:
    """A scene, its pages, and the thread that draws for them."""

    def __init__(self, scene: Scene, uri: str, edits: Edits, out: Path, backend: str) -> None:
        self.scene = scene
        self.uri = uri
        self.edits = edits
        self.out = out
        self.backend = backend
        self.frames = tuple(frame for frame in scene.frames if frame.cameras)
        self.changed = threading.Condition()
        self.pages: list[Page] = []
        self._is_ending = False
        self._compiled_sections: set[tuple[str, ...]] = set()  # their kernels have run
        self._activity: tuple[Page, Activity] | None = None
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._end = threading.Event()
        self._ticker = threading.Thread(target=self._update_pages, name="status", daemon=True)

    def start(self) -> None:
        self._thread.start()
        self._ticker.start()

    def stop(self) -> None:
        self._end.set()
        with self.changed:
            self._is_ending = True
            self.changed.notify()
        self._thread.join(JOIN_S)
        self._ticker.join(JOIN_S)

    def activity_for(self, page: Page) -> Activity | None:
        """Return the thread's work for a page; None while it works for another page."""
        current = self._activity
        if current is None:
            return Activity()
        return current[1] if current[0] is page else None

    def _note_pass(self, progress: PassProgress) -> None:
        """Store the pass, or the step of a pass, that the thread has reached."""
        if self._activity is not None:
            self._activity[1].progress = progress

    def _update_pages(self) -> None:
        """Update the status lines of all pages every TICK_S seconds until the server ends."""
        while not self._end.wait(TICK_S):
            for page in tuple(self.pages):
                page.update_status()

    def open_page(self, client: ClientHandle) -> Callable[[str], None]:
        page = Page(self, client)
        with self.changed:
            self.pages.append(page)
            self.changed.notify()
        return page.show_error

    def close_page(self, client: ClientHandle) -> None:
        with self.changed:
            for page in self.pages:
                page.is_closed = page.is_closed or page.client.client_id == client.client_id
            self.pages = [page for page in self.pages if not page.is_closed]

    def report(self, page: Page, error: Exception) -> None:
        """Show an error on its page. Log the traceback if it is a defect of this program."""
        if page.is_closed:
            return
        if not isinstance(error, ClimateGSError | RecipeError):
            _LOG.error("%s", "".join(traceback.format_exception(error)))
        page.show_error(f"{type(error).__name__}: {error}")

    # ---- The thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        with _compilations_counted(self._count_compiling):
            self._serve_pages()

    def _count_compiling(self, change: int) -> None:
        """Count a compilation of a kernel. change: 1 when it begins, -1 when it ends."""
        if self._activity is not None:
            activity = self._activity[1]
            activity.compiling = max(0, activity.compiling + change)
            activity.compiled += change < 0

    def _serve_pages(self) -> None:
        while True:
            with self.changed:
                page, work = self._next_work()
                while page is None and not self._is_ending:
                    self.changed.wait(work)
                    page, work = self._next_work()
                if self._is_ending:
                    return
                # The others come first next time.
                self.pages.sort(key=lambda entry: entry is page)
            assert page is not None
            self._activity = (page, Activity())
            try:
                self._do_work(page, work)
            except Exception as error:
                self.report(page, error)
            finally:
                self._activity = None

    def _next_work(self) -> tuple[Page | None, Any]:
        """Return the page to work for next.

        Returns:
            The page that has waited longest, and its work. If no page has work: None, and the
            seconds until there is work, or None if work begins only after a change.
        """
        now = time.monotonic()
        pause = None
        for page in self.pages:
            if page.progress.tasks:
                return page, page.progress.tasks.popleft()
        for page in self.pages:
            progress = page.progress
            is_moving = now - progress.last_change_time < REST_S or page.request.is_playing
            if progress.drawn_number < progress.request_number and is_moving:
                return page, "moving"
        for page in self.pages:
            progress = page.progress
            is_playing = page.request.is_playing
            if not is_playing and progress.rest_number == progress.request_number:
                continue
            wait_s = (
                progress.next_frame_time if is_playing else progress.last_change_time + REST_S
            ) - now
            if wait_s <= 0:
                return page, "advance" if is_playing else "rest"
            if wait_s < math.inf:
                pause = wait_s if pause is None else min(pause, wait_s)
        return None, pause

    def _do_work(self, page: Page, work: Any) -> None:
        if callable(work):
            work()
            return
        if work == "advance":
            page.advance()
            return
        with self.changed:
            request = page.request
            request_number = page.progress.request_number
        moving = work == "moving"
        progress = page.progress
        progress.next_frame_time = math.inf
        due = time.monotonic() + PLAY_S
        try:
            self._draw(page, request, moving=moving)
            progress.next_frame_time = due
        except _Outdated:
            # A small picture comes first, however long the pass took.
            progress.last_change_time = time.monotonic()
        except Exception:
            page.show_failure(request)
            raise
        finally:  # what failed is not tried again before something changes
            progress.drawn_number = request_number
            if not moving:
                progress.rest_number = request_number

    # ---- One picture -----------------------------------------------------------------------------

    def _draw(self, page: Page, request: ViewRequest, *, moving: bool) -> None:
        refusal = None
        try:
            recipe = page.recipe(request.edits)
        except RecipeError as error:
            refusal = str(error)
            recipe = page.last_valid_recipe
            if recipe is None:
                raise
        recipe = page.recipe_at(request, recipe)
        camera = page.camera_of(request)
        factor = self._factor(page, request, recipe, camera)
        if moving:
            factor *= page.progress.factor
        start_s = time.perf_counter()
        with self._compile_new_kernels(recipe):
            view, pass_seconds = self._picture(page, request, recipe, camera, factor, moving=moving)
            height, width = view.rgb.shape[:2]
            if request.pose is None:
                place = place_in_window(camera.resized(width, height), page.aspect)
                view = add_window_bars(view, place)
            draw_s = time.perf_counter() - start_s
            if page.is_closed:
                return
            page.show_picture(view.rgb, view.depth_m, moving=moving)
            if moving:
                page.progress.factor = _next_factor(page.progress.factor, draw_s)
            picture = ShownPicture(
                request=request,
                width=width,
                height=height,
                seconds=draw_s,
                sent_at=time.monotonic(),
                is_at_rest=not moving,
                is_complete=not request.lidar,
                is_valid=refusal is None,
            )
            page.show_progress(picture)
            page.show_warning(distance_warning(self.scene, camera))
            page.show_error(refusal)
            if not moving:
                self._show_details(page, request, recipe, camera, pass_seconds)
                page.show_progress(replace(picture, is_complete=True))

    def _picture(
        self,
        page: Page,
        request: ViewRequest,
        recipe: Recipe,
        camera: Camera,
        factor: float,
        *,
        moving: bool,
    ) -> tuple[PageImage, dict[str, float]]:
        """Return the picture without bars, and the seconds of its passes by their names.

        Args:
            page: The page.
            request: The page's request when the work began.
            recipe: The request's recipe, or the last valid one.
            camera: The camera, before the recipe's scale.
            factor: The resolution relative to the recipe's.
            moving: True while something moves.

        Raises:
            _Outdated: the picture is no longer needed. Before a pass at rest: the page is closed
                or its request has changed. Within a preparation: the page is closed, or its
                request lacks an effect of the recipe.
        """

        def check_request(progress: PassProgress) -> None:
            self._note_pass(progress)
            if page.is_closed:
                raise _Outdated
            if page.request is request:
                return
            if progress.num_steps:  # most of what follows needs it, too: a depth that is dragged
                if _lacks_effect_of(page, recipe):
                    raise _Outdated
            elif not moving:
                raise _Outdated

        def draw_recipe(recipe: Recipe) -> PageImage:
            recipe = recipe_to_show(
                recipe, request.shows, with_depth=request.needs_depth, factor=factor
            )
            if moving:
                recipe = coarse_recipe(recipe, request.shows, with_depth=request.needs_depth)
            view = draw(self.scene, camera, recipe, request.shows, backend=self.backend)
            return view if request.needs_depth else replace(view, depth_m=None)

        timer = contextlib.nullcontext({}) if moving else stopwatch()
        with watched(check_request), timer as pass_seconds:
            view = draw_recipe(recipe)
        if request.is_split:
            clear = without_weather(recipe)
            size = view.rgb.shape
            key = (
                request.frame,
                request.camera,
                request.pose,
                request.shows,
                size,
                moving,
                clear.render,
            )
            if page.clear_picture is None or page.clear_picture[0] != key:
                with watched(check_request):
                    page.clear_picture = (key, draw_recipe(clear).rgb)
            view = PageImage(
                split_pictures(page.clear_picture[1], view.rgb, request.share), view.depth_m
            )
        return view, pass_seconds

    def _factor(self, page: Page, request: ViewRequest, recipe: Recipe, camera: Camera) -> float:
        """Return the resolution that the window needs, relative to the recipe's: 1 or less.

        Raises:
            ClimateGSError: every pixel is asked for, and there are too many.
        """
        scale = recipe.render.scale
        width = camera.width
        height = camera.height
        if request.pose is None:
            width, height = place_in_window(camera, page.aspect).size
        if request.every_pixel:
            check_size(width * scale, height * scale)
            return 1.0
        fitting = math.sqrt(MAX_PIXELS / (width * height)) / scale
        return min(1.0, page.window_height / (height * scale), fitting)

    def _show_details(
        self,
        page: Page,
        request: ViewRequest,
        recipe: Recipe,
        camera: Camera,
        pass_seconds: dict[str, float],
    ) -> None:
        """Show all that follows a picture at rest: overlays, the plan and the command line."""
        points = None
        if request.lidar:
            self._note_pass(PassProgress("LiDAR returns"))
            points = lidar_points(self.scene, page.frame_of(request), recipe)
        viewpoint = request.frustums and (request.camera if request.pose is None else "flight")
        key = (request.frame, request.boxes, viewpoint, request.lidar and recipe)
        if page.overlay_key != key:
            page.show_overlays(request, points)
            page.overlay_key = key
        _, plan = plan_at(recipe, self.scene, camera.timestamp_ns)
        steps = plan_view(plan, self.scene, camera).steps
        rows = [(step.name, _milliseconds(pass_seconds.get(step.name)), step.why) for step in steps]
        page.show_plan(table(("pass", "ms", "why, or why not"), rows, [s.runs for s in steps]))
        page.show_command(self._command(page, request))

    @contextlib.contextmanager
    def _compile_new_kernels(self, recipe: Recipe) -> Iterator[None]:
        """Compile the kernels of new effects on all cores, while the block runs."""
        if not self._is_new(recipe):
            yield
            return
        with compiling_noted(kernel_modules([recipe], self.backend)):
            yield
            self._count_compiling(1)  # processes beside this one may compile on
        self._count_compiling(-1)
        self._compiled_sections.add(tuple(recipe.sections()))

    def _is_new(self, recipe: Recipe) -> bool:
        return tuple(recipe.sections()) not in self._compiled_sections

    # ---- Tasks of pages --------------------------------------------------------------------------

    def measure_tiers(self, page: Page) -> None:
        """Show the time of the view at rest in each tier, and its difference from the reference."""
        request = page.request
        camera = page.camera_of(request)
        scale = page.recipe(request.edits).render.scale
        check_size(camera.width * scale, camera.height * scale)
        pictures: dict[str, tuple[float, np.ndarray]] = {}
        for tier in (*TIERS, "reference"):
            recipe = page.recipe_at(request, request.edits.with_tier(tier).recipe())
            recipe = recipe_to_show(recipe, request.shows, with_depth=False, factor=1.0)
            rgb = render_view(self.scene, camera, recipe, backend=self.backend).rgb
            times = []  # without what is prepared once
            for _ in range(2):
                start_s = time.perf_counter()
                render_view(self.scene, camera, recipe, backend=self.backend)
                times.append(time.perf_counter() - start_s)
            pictures[tier] = (min(times), rgb)
        best = pictures["reference"][1].astype(float)
        rows = []
        for tier, (seconds, rgb) in pictures.items():
            height, width = rgb.shape[:2]
            enlarged = cv2.resize(rgb, best.shape[1::-1], interpolation=cv2.INTER_CUBIC)
            difference = f"{np.abs(enlarged - best).mean():.2f}"
            rows.append((tier, f"{width} x {height}", f"{1000 * seconds:.0f}", difference))
        page.show_tiers(table(("tier", "size", "ms", "mean difference, of 255"), rows))

    def save(self, page: Page, name: str, *, with_picture: bool) -> None:
        """Save the recipe of a page, and in a flight also its camera, below the output folder.

        Args:
            page: The page.
            name: The name of the recipe and of its files.
            with_picture: True if the picture is saved, too.

        Raises:
            RecipeError: a recipe cannot have the name, or the edits make no valid recipe.
            ClimateGSError: the picture is too large, or the folder cannot be written.
        """
        request = page.request
        recipe = rename_recipe(page.recipe_at(request, page.recipe(request.edits)), name)
        if with_picture:
            camera = page.camera_of(request)
            scale = recipe.render.scale
            check_size(camera.width * scale, camera.height * scale)
        endings = (".yaml", ".camera.json", f".{recipe.output.image}")
        path = None
        while path is None:
            path = unused_path(self.out, name, *endings)
            try:
                save_recipe(recipe, path.with_name(path.name + ".yaml"))
            except FileExistsError:  # since we looked
                path = None
        file_names = [path.name + ".yaml"]
        camera = page.recorded_camera(request)
        view_words = self._view_words(request, camera_path=None)
        if request.pose is not None:
            camera_path = path.with_name(path.name + ".camera.json")
            self._write_path(page.camera_of(request), camera_path)
            # As the file says it, to the bit.
            (frame,) = frames_from_path_file(camera_path, self.scene)
            camera = frame.cameras[camera.name]
            file_names.append(camera_path.name)
            view_words = self._view_words(request, camera_path=camera_path)
        if with_picture:
            view = render_view(self.scene, camera, recipe, backend=self.backend)
            picture = path.with_name(f"{path.name}.{recipe.output.image}")
            write_new_file(picture, encode_image(view.rgb, recipe.output))
            file_names.append(picture.name)
        source = shlex.quote(str(path.with_name(path.name + ".yaml")))
        out = shlex.quote(str(path.with_name(path.name + "-images")))
        page.show_saved(
            f"Saved {', '.join(file_names)} in {self.out}",
            f"climategs render {source} {view_words} --out {out}",
        )

    def _write_path(self, camera: Camera, path: Path) -> None:
        pose = camera.world_from_camera.clone().numpy()
        pose[:3, 3] += np.asarray(self.scene.world_origin_m)
        start_ns = self.scene.frames[0].timestamp_ns
        sizes = {
            name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
        }
        frame = {
            "timestamp_s": (camera.timestamp_ns - start_ns) / 1e9,
            "camera": camera.name,
            "world_from_camera": pose.tolist(),
        }
        write_new_file(path, (json.dumps({**sizes, "frames": [frame]}, indent=1) + "\n").encode())

    def _view_words(self, request: ViewRequest, camera_path: Path | None) -> str:
        """Return the options of a command line for a request's scene and view.

        Args:
            request: The request.
            camera_path: The file of a flight's camera; None for the recorded camera.
        """
        scene = f"--scene {shlex.quote(self.uri)}"
        if camera_path is not None:
            return f"{scene} --camera-path {shlex.quote(str(camera_path))}"
        return (
            f"{scene} --frames {self.frames[request.frame].index} "
            f"--cameras {shlex.quote(request.camera)}"
        )

    def _command(self, page: Page, request: ViewRequest) -> str:
        """Return the command line that renders a request's view.

        A flight and uploaded files have no command line before the recipe is saved. They get a
        note instead.
        """
        files = any(path.endswith(("image", "mask", "checkpoint")) for path in request.edits.values)
        if files or request.pose is not None or request.is_weather_held:
            unsaved_part = "a flight" if request.pose is not None else "an uploaded file"
            if request.is_weather_held:
                unsaved_part = "weather of another time"
            return f"# {unsaved_part}: save the recipe first, and the command will stand here"
        return request.edits.command(f"{self._view_words(request, None)} --out out/view")


def check_size(width: float, height: float) -> None:
    """Check that a picture is not too large to be drawn for a page.

    Raises:
        ClimateGSError: it has more than MAX_PIXELS.
    """
    if width * height > MAX_PIXELS:
        raise ClimateGSError(
            f"the picture has {width:.0f} x {height:.0f} pixels; a page has at most "
            f"{MAX_PIXELS / 1e6:.0f} million drawn: lower render.scale, look through a smaller "
            f"angle, or save the recipe and use `climategs render`"
        )


@contextlib.contextmanager
def _compilations_counted(count: Callable[[int], None]) -> Iterator[None]:
    """Count compilations of numba while the block runs, without kernels that numba has cached.

    Args:
        count: A function that is called with 1 when a compilation begins and with -1 when it ends.
    """
    from numba.core.event import Event, Listener, install_listener

    class Counter(Listener):
        def on_start(self, event: Event) -> None:
            count(1)

        def on_end(self, event: Event) -> None:
            count(-1)

    with install_listener("numba:compile", Counter()):
        yield


class _Outdated(Exception):
    """Raised when the picture in work is no longer needed."""


def _lacks_effect_of(page: Page, recipe: Recipe) -> bool:
    """Return True if the page now asks for a recipe that lacks an effect of `recipe`."""
    try:
        page_recipe = page.recipe(page.request.edits)
    except RecipeError:
        return False
    return not recipe.sections().keys() <= page_recipe.sections().keys()


def _next_factor(factor: float, seconds: float) -> float:
    """Return the share of the full resolution for the next picture while something moves.

    Args:
        factor: The share of the last picture.
        seconds: The time that the last picture took.
    """
    if seconds > FRAME_S:
        factor *= max(0.7, FRAME_S / seconds)
    elif seconds < FRAME_S / 2:
        factor *= 1.15
    return min(max(factor, FACTORS[0]), FACTORS[1])


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1000 * seconds:.1f}"
