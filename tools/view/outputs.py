"""An output folder in the browser: its images, selected by scene, camera, frame and weather."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from augment.errors import OutputError
from augment.files.image_size import image_header
from augment.output.codecs import decode_image, decode_png, depth_in_metres
from augment.output.layout import mask_names
from augment.output.manifest import OK, Row, read_manifest_rows, weather_columns
from augment.output.names import MANIFEST_FILE, resolve_inside
from augment.output.store import Store, open_store
from recipes.files import open_file
from recipes.schema import columns_of_effects
from tools.view.fields import NONE
from tools.view.pictures import BAR, color_classes, color_depth, color_numbers, split_pictures
from tools.view.text import paragraph, printable, table
from tools.view.widgets import options_of

if TYPE_CHECKING:
    from viser import ClientHandle

STEPS = 200  # The number of steps of a slider of numbers.
MAX_PIXELS = 2**27  # The most pixels of an image that is shown.
MAX_BYTES = 2**29  # The largest file of such an image, bytes.
MIN_RANGE = 1e-30  # The least difference between the ends of a slider of numbers.
MAX_ASPECT = 8.0  # The largest ratio of a window's longer side to its shorter one.


def find_output(text: str) -> Store | None:
    """Return the output of `climategs render` or `generate` that a text names.

    Args:
        text: The `--scene` of a command: a folder or a bucket, or an address of a scene.

    Returns:
        The folder or bucket; None if the text names none with a manifest.

    Raises:
        OutputError: a bucket cannot be read.
    """
    if "://" not in text:
        return open_store(text) if (Path(text) / MANIFEST_FILE).is_file() else None
    store = open_store(text)
    return store if store.exists(MANIFEST_FILE) else None


class OutputViewer:
    """The finished images of an output folder or bucket, for the pages of one server.

    Args:
        store: The folder or bucket.

    Raises:
        OutputError: there is no finished image, or the manifest is damaged.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        table = read_manifest_rows(store)
        self.rows: list[Row] = [row for row in table.to_pylist() if row["status"] == OK]
        if not self.rows:
            raise OutputError(f"{store.uri} holds no finished image; run `climategs render` first")
        self.numbers = [name for name in weather_columns(table) if self._is_range(name)]
        self.pages: dict[int, OutputPage] = {}

    def values(self, column: str) -> list[Any]:
        """Return the sorted values of a column, without NaN and without None."""
        values = {row[column] for row in self.rows}
        return sorted(value for value in values if value is not None and value == value)

    def _is_range(self, column: str) -> bool:
        """Return True if a column can have a slider: at least two numbers, with finite ends."""
        values = self.values(column)
        if len(values) < 2 or not all(isinstance(value, int | float) for value in values):
            return False
        return math.isfinite(width := float(values[-1]) - float(values[0])) and width > MIN_RANGE

    def picture(self, row: Row, shows: str) -> np.ndarray:
        """Return the picture of a row's file, uint8 [H, W, 3].

        Args:
            row: The row of the manifest.
            shows: The kind of the file: "image", "depth", "semantic", "instance" or a mask.

        Raises:
            OutputError: the file is missing or damaged, or the row has none.
        """
        relative = row[f"{shows}_path"]
        if not relative:
            raise OutputError(f"{row['variant']} has no {shows} images")
        try:
            data = self._read(relative)
            header = image_header(data)
            if header is not None and header.width * header.height > MAX_PIXELS:
                raise ValueError(
                    f"it says that it has {header.width} x {header.height} pixels; at most "
                    f"{MAX_PIXELS / 1e6:.0f} million are shown"
                )
            if shows == "image":
                return decode_image(data)
            if shows == "depth":
                return color_depth(depth_in_metres(decode_png(data, np.uint16)))
            if shows == "instance":
                return color_numbers(decode_png(data, np.uint16))
            numbers = decode_png(data, np.uint8)
        except (OSError, ValueError) as error:
            raise OutputError(f"cannot read {self.store.uri}/{relative}: {error}") from error
        return color_classes(numbers) if shows == "semantic" else np.stack([numbers] * 3, -1)

    def _read(self, relative: str) -> bytes:
        """Return the bytes of a file that the manifest names."""
        local_dir = self.store.local_dir
        if local_dir is None:
            return self.store.read(relative)
        with open_file(resolve_inside(local_dir, relative)) as file:  # no pipe, which may wait
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES // 2**20} MiB")
        return data

    def start(self) -> None:
        """Do nothing: no thread draws for the pages."""

    def stop(self) -> None:
        """Do nothing: no thread draws for the pages."""

    def open_page(self, client: ClientHandle) -> Callable[[str], None]:
        """Open a page. Return the function that shows a message on it."""
        self.pages[client.client_id] = page = OutputPage(self, client)
        return page.show_status

    def close_page(self, client: ClientHandle) -> None:
        """Forget a client's page."""
        self.pages.pop(client.client_id, None)


class OutputPage:
    """One client's page. All of its work is short, and runs on the server's event loop."""

    def __init__(self, viewer: OutputViewer, client: ClientHandle) -> None:
        self.viewer = viewer
        self.client = client
        rows = viewer.rows
        gui = client.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        gui.set_panel_label(printable(f"ClimateGS: {viewer.store.uri.rpartition('/')[2]}"))
        self._status = gui.add_html("")
        self._options: dict[str, dict[str, Any]] = {}  # by the dropdown's label
        self._scene = self._add_dropdown("scene", viewer.values("scene"))
        self._camera = self._add_dropdown("camera", viewer.values("camera"))
        frames = viewer.values("frame")
        self._frame = gui.add_slider("frame", 0, max(len(frames) - 1, 1), 1, 0)
        self._variant = self._add_dropdown("variant", viewer.values("variant"))
        kinds = ("image", "depth", "semantic", "instance", *mask_names())
        row_kinds = [k for k in kinds if any(row.get(f"{k}_path") for row in rows)]
        self._shows = self._add_dropdown("shows", row_kinds)
        self._left_variant = self._add_dropdown(
            "left of the line", [NONE, *viewer.values("variant")]
        )
        self._line = gui.add_slider("line", 0.0, 1.0, 0.005, 0.5)
        self._ranges: dict[str, Any] = {}
        with gui.add_folder("only images with", visible=bool(viewer.numbers)):
            for name in viewer.numbers:
                self._ranges[name] = self._add_range_slider(name)
        self._facts = gui.add_html("")
        self._frames = frames
        for part in (self._frame, self._line):
            self._subscribe(part, self._show)
        self._show()
        client.camera.on_update(self._on_camera)

    def _add_dropdown(self, label: str, values: list[Any]) -> Any:
        self._options[label] = options_of(values)
        part = self.client.gui.add_dropdown(label, tuple(self._options[label]))
        self._subscribe(part, self._show)
        return part

    def _selected_value(self, part: Any) -> Any:
        """Return the value that a dropdown's selected option stands for."""
        return self._options[part.label][part.value]

    def _add_range_slider(self, name: str) -> Any:
        values = self.viewer.values(name)
        low = float(values[0])
        high = float(values[-1])
        step = 10.0 ** math.floor(math.log10((high - low) / STEPS))
        low = math.floor(low / step) * step
        high = math.ceil(high / step) * step
        column = columns_of_effects().get(name)
        hint = column.title if column is not None else name
        part = self.client.gui.add_multi_slider(
            name, low, high, step=step, initial_value=(low, high), hint=hint
        )
        self._subscribe(part, self._narrow)
        return part

    def _subscribe(self, part: Any, act: Callable[[], None]) -> None:
        @part.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                act()

    def show_status(self, text: str) -> None:
        self._status.content = paragraph(text)

    async def _on_camera(self, _: Any) -> None:
        self._show()

    def _matches(self, row: Row) -> bool:
        """Return True if all numbers of a row lie in the ranges of the page's sliders. A number
        that the row lacks is in the full range only.
        """
        for name, part in self._ranges.items():
            low, high = part.value
            value = row[name]
            is_missing = value is None or value != value
            if is_missing and (low > part.min or high < part.max):
                return False
            if not is_missing and not low <= value <= high:
                return False
        return True

    def _narrow(self) -> None:
        """Offer only the variants with an image whose numbers lie in the page's ranges."""
        rows = [row for row in self.viewer.rows if self._matches(row)]
        variants = sorted({row["variant"] for row in rows})
        if variants:
            self._options["variant"] = options_of(variants)
            self._variant.options = tuple(self._options["variant"])
        self._show()

    def _show(self) -> None:
        matching = [row for row in self.viewer.rows if self._matches(row)]
        frame = self._frames[min(self._frame.value, len(self._frames) - 1)]
        scene, camera, shows = map(self._selected_value, (self._scene, self._camera, self._shows))
        view = {"scene": scene, "camera": camera, "frame": frame}
        row = self._find(matching, view | {"variant": self._selected_value(self._variant)})
        count = f"{len(matching)} of {len(self.viewer.rows)} images"
        if row is None:
            self.show_status(f"{count}; none of this scene, camera, frame and variant")
            return
        try:
            picture = self.viewer.picture(row, shows)
            left_row = self._find(
                self.viewer.rows, view | {"variant": self._selected_value(self._left_variant)}
            )
            if left_row is not None:
                left_picture = self.viewer.picture(left_row, shows)
                if left_picture.shape == picture.shape:
                    picture = split_pictures(left_picture, picture, self._line.value)
        except OutputError as error:
            self.show_status(f"{count}; {error}")
            return
        window = self.client.camera
        aspect = window.image_width / max(window.image_height, 1)
        shape = with_aspect(picture, min(max(aspect, 1 / MAX_ASPECT), MAX_ASPECT))
        self.client.scene.set_background_image(shape, "png")
        self.show_status(f"{picture.shape[1]} x {picture.shape[0]}; {count}")
        self._facts.content = _facts_of(row)

    def _find(self, rows: list[Row], values: Row) -> Row | None:
        return next((row for row in rows if values.items() <= row.items()), None)


def with_aspect(picture: np.ndarray, aspect: float) -> np.ndarray:
    """Return a picture with bars, so that it has another aspect and loses no pixel.

    Args:
        picture: [H, W, 3], uint8.
        aspect: Width divided by height.
    """
    height, width = picture.shape[:2]
    extra_width = max(0, round(height * aspect) - width)
    extra_height = max(0, round(width / aspect) - height)
    left = extra_width // 2
    top = extra_height // 2
    sides = (top, extra_height - top, left, extra_width - left)
    return cv2.copyMakeBorder(picture, *sides, cv2.BORDER_CONSTANT, value=(BAR, BAR, BAR))


def _facts_of(row: Row) -> str:
    """Return an HTML table of an image's values in the manifest."""
    facts = {n: v for n, v in row.items() if v not in (None, "") and v == v}
    words = (f"{v:g}" if isinstance(v, float) else str(v) for v in facts.values())
    return table(("column", "value"), zip(facts, words, strict=True))
