"""`climategs view`: controls made from models, edits as command lines say them, and whole pages as
a browser sees them.
"""

from __future__ import annotations

import dataclasses
import math
import os
import shlex
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from websockets.exceptions import InvalidStatus

from augment import effects
from augment.errors import ClimateGSError, OutputError
from augment.output.manifest import rows_to_table, write_manifest
from augment.output.store import open_store
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid
from augment.scene.scene_times import scene_times
from augment.timing import PassProgress, counted_steps
from augment.view.render_view import render_view
from recipes.errors import RecipeError
from recipes.fields import section_at, with_unchecked_field
from recipes.load import dump_recipe, load_recipe, parse_recipe, preset_names
from recipes.schema import SECTIONS
from recipes.sections import recipe_file
from tests.augment.batch_scenes import open_fake
from tests.augment.dust import DustEffect
from tests.streets import LABELLED_STREET, SMALL_STREET, open_street
from tests.tools.page_client import PageClient
from tests.tools.report_outputs import make_row, write_output
from tools.cli import main
from tools.view.controls import (
    MAX_HINT,
    USEFUL_ENDS,
    Control,
    effect_groups,
    group_of,
    split_by_rank,
)
from tools.view.edits import (
    Edits,
    hold_weather,
    save_recipe,
    start_values,
    unused_path,
    without_weather,
)
from tools.view.outputs import OutputViewer, find_output
from tools.view.page import ViewRequest
from tools.view.pictures import (
    PICTURE,
    distance_warning,
    draw,
    free_camera,
    place_in_window,
    recipe_to_show,
)
from tools.view.server import Viewer, import_viser, serve
from tools.view.status import Activity, ShownPicture, page_status

SCALE = 0.2


@pytest.fixture
def dust() -> Iterator[None]:
    effects.add_effect(DustEffect())
    yield
    effects.remove_effect("dust")


@contextmanager
def served(edits: Edits, uri: str = SMALL_STREET) -> Iterator[tuple[Viewer, str]]:
    viewer = Viewer(open_street(uri), uri, edits, edits.folder, "cpu")
    with serve(import_viser(), viewer, "127.0.0.1", 0) as url:
        yield viewer, url


# ---- Controls ------------------------------------------------------------------------------------


def test_every_field_of_every_effect_has_a_control_whose_ends_its_model_takes(dust):
    leaves = {leaf.path: leaf for s in recipe_file().walk() for leaf in s.leaves.values()}
    groups = (*effect_groups(), group_of("camera"), group_of("render"))
    assert {group.path for group in groups} == {*SECTIONS, "camera", "render"}
    for group in groups:
        there = {control.path for control in group.walk()}
        fields = {p for p in leaves if p.startswith(f"{group.path}.") and "[]" not in p}
        others = tuple(f"{path}." for path in SECTIONS if path != group.path)
        fields = {path for path in fields if not path.startswith(others)}
        hidden = {f"{group.path}.digest", f"{group.path}.probability", "render.speed.settled"}
        assert fields - there <= hidden
        for control in group.walk():
            assert control.hint
            if control.kind != "slider":
                continue
            leaf, kind = leaves[control.path], int if control.is_integer else float
            for way in np.linspace(0, 1, 41):
                value = kind(control.value_at(way))
                assert leaf.accepts(value), (control, way, value)
                if not control.is_integer and control.position_at(value) not in (0, 1):
                    assert control.value_at(control.position_at(value)) == pytest.approx(
                        value, 0.006
                    )
    paths = {c.path: c for group in groups for c in group.walk()}
    half = paths["weather.dust.half_m"]
    assert (half.scale, half.high, half.hint.split()[-1]) == ("log", 1e6, "[metres]")
    assert paths["weather.dust.distance"].words == ("depth", "ray")
    assert paths["weather.flood.level_m"].value_at(0.5) == 1
    assert paths["weather.smog.overcast"].step == 0.005


def test_an_effect_that_is_switched_on_starts_from_values_its_model_takes(dust):
    for section in SECTIONS:
        edits = Edits("clear").with_section(section)
        assert section_at(edits.recipe(), section).has_effect, start_values(section)
        assert section_at(edits.without_section(section).recipe(), section) is None


def sliders() -> list[Control]:
    groups = (*effect_groups(), group_of("camera"), group_of("render"))
    return [c for group in groups for c in group.walk() if c.kind == "slider"]


def test_sliders_reach_what_presets_draw_and_boxes_all_that_a_recipe_takes():
    recipes = [load_recipe(name).resolve(variant) for name in preset_names() for variant in (0, 1)]
    leaves = {leaf.path: leaf for s in recipe_file().walk() for leaf in s.leaves.values()}
    for control in sliders():
        section = control.path.rpartition(".")[0]
        for recipe in recipes:
            value = (
                section_at(recipe, control.path)
                if section_at(recipe, section) is not None
                else None
            )
            if value is not None and value != control.default:
                assert control.low <= value <= control.high, control.path
        assert len(control.marks) >= 2, control.path
        least, most = control.valid
        assert least <= control.low < control.high <= most
        for value in control.valid:  # the ends of the box
            assert leaves[control.path].accepts(int(value) if control.is_integer else value)
        if control.scale == "both sides":
            assert control.high - control.low <= 200, control.path
        elif control.scale == "log" and control.path in USEFUL_ENDS:
            assert control.high <= 1e4 * control.smallest_nonzero, control.path  # four decades
    ends = {control.path: (control.low, control.high) for control in sliders()}
    assert ends["weather.smog.base_height_m"] == (-50, 50)  # of -10,000 to 10,000
    assert ends["weather.flood.level_m"] == (-1, 3)
    assert ends["weather.rain.wind_from_deg"] == (0, 360)
    assert ends["weather.snow.depth_m"] == (0, 1)
    boxes = {control.path: control.valid for control in sliders()}
    assert boxes["weather.flood.level_m"] == (-10_000, 10_000)


def test_twelve_fields_come_first_and_tooltips_are_short():
    main, others = split_by_rank(effect_groups())
    first = [control.path for group in main for control in group.main_controls]
    assert len(first) == 12 and "weather.smog.visibility_m" in first
    for group in main:
        paths = {control.path for control in (*group.main_controls, *group.secondary_group.walk())}
        assert paths == {control.path for control in group.walk()}  # none is lost
    assert {group.path for group in (*main, *others)} == set(SECTIONS)
    for group in (*main, *others):
        tooltips = [group.tooltip, *(control.tooltip for control in group.walk())]
        assert max(map(len, tooltips)) <= MAX_HINT + len(" [nephelometric turbidity units]")


# ---- What a page says ----------------------------------------------------------------------------


def test_at_rest_is_said_of_the_whole_picture_of_the_request_alone():
    request = ViewRequest(Edits("clear"), 0, "front")
    at_rest = ShownPicture(request, 320, 180, 0.03, sent_at=1.0, is_at_rest=True)
    placing = Activity(PassProgress("finding exposed surfaces", 12, 21))

    def said(
        shown: ShownPicture | None, request: ViewRequest, activity: Activity | None, **own: Any
    ) -> str:
        return page_status(shown, request, activity, **{"waited_s": 0.0, "now": 1.1, **own}).text

    assert said(at_rest, request, Activity()) == "320 x 180 at rest, 30 ms"
    snowy = dataclasses.replace(request, edits=Edits("fresh-snow"))
    assert said(at_rest, snowy, Activity()) == "Picture not of this recipe yet: drawing"
    assert said(at_rest, snowy, placing, waited_s=4.2) == (
        "Picture not of this recipe yet: finding exposed surfaces, step 12 of 21, 4 s"
    )
    assert said(at_rest, snowy, Activity(compiling=1, compiled=3)) == (
        "Picture not of this recipe yet: compiling kernels (only the first time, 3 done)"
    )
    assert "waiting for the picture of another page" in said(at_rest, snowy, None)
    assert "not of this view yet" in said(
        at_rest, dataclasses.replace(request, frame=1), Activity()
    )
    assert "not up to date yet" in said(
        at_rest, dataclasses.replace(request, boxes=True), Activity()
    )
    assert said(None, request, Activity()) == "First picture: drawing"
    rough = dataclasses.replace(at_rest, is_at_rest=False)
    assert said(rough, request, Activity()) == "320 x 180 while moving, 30 ms"
    assert said(rough, request, Activity(PassProgress("sky")), now=2.0) == (
        "Rough picture, the whole one follows: drawing (sky)"
    )
    bare = dataclasses.replace(at_rest, is_complete=False)
    assert said(bare, request, Activity(PassProgress("LiDAR returns"))) == (
        "Picture, what lies over it follows: drawing (LiDAR returns)"
    )
    refused = dataclasses.replace(at_rest, is_valid=False)
    assert "of the last recipe that was valid" in said(refused, request, Activity())
    assert said(at_rest, request, Activity(), has_failed=True) == "Not drawn"
    status = page_status(at_rest, snowy, placing, waited_s=4.2, now=9.0)
    assert status.share == pytest.approx(12 / 21) and status.is_long and not status.is_current


def test_what_is_drawn_at_rest_has_the_bits_of_a_rendered_image_whatever_else_is_written():
    scene = open_street()
    camera = scene.frames[0].cameras["front"]
    recipe = Edits("light-haze", SCALE).recipe()
    for path, value in (("output.depth", "median"), ("output.semantic", True)):
        recipe = with_unchecked_field(recipe, path, value)
        asked = recipe_to_show(recipe, PICTURE, with_depth=False, factor=1.0)
        rgb = render_view(scene, camera, recipe).rgb
        assert np.array_equal(draw(scene, camera, asked, PICTURE).rgb, rgb)


def test_a_camera_away_from_all_recorded_images_is_told():
    scene = open_street()
    own = scene.frames[0].cameras["front"]
    assert distance_warning(scene, own) is None
    pose = own.world_from_camera
    for forward_m, up_m, turn_rad, said in (
        (1.0, 0.0, 0.0, None), (0.0, 1.9, 0.0, None), (0.0, 0.0, 0.2, None),
        (0.0, 6.0, 0.0, "6.0 m and 0 degrees"), (0.0, 0.0, 0.5, "0.0 m and 29 degrees"),
    ):  # fmt: skip
        tilt = torch.eye(4, dtype=torch.float64)
        tilt[1:3, 1:3] = torch.tensor(
            [[math.cos(turn_rad), -math.sin(turn_rad)], [math.sin(turn_rad), math.cos(turn_rad)]]
        )
        tilt[1, 3], tilt[2, 3] = -up_m, forward_m
        camera = dataclasses.replace(own, camera_from_world=invert_rigid(pose @ tilt))
        sentence = distance_warning(scene, camera)
        assert (sentence is None) == (said is None), (forward_m, up_m, turn_rad, sentence)
        assert said is None or f"Outside of what was recorded: {said}" in str(sentence)


# ---- Edits ---------------------------------------------------------------------------------------


def test_a_command_line_says_what_the_page_does():
    edits = Edits("winter-fog", 0.5).with_section("weather.flood").without_section("weather.snow")
    edits = edits.with_values({"weather.smog.visibility_m": "60", "seed": "5", "variant": "3"})
    words = shlex.split(edits.command("--scene x --out y"))
    sets = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    from tools.render import resolve_recipes

    (recipe,) = resolve_recipes([words[2]], 1, 0.5, sets)
    assert recipe == edits.recipe() and (recipe.seed, recipe.variant) == (5, 3)
    assert recipe.weather.smog is not None and recipe.weather.smog.visibility_m == 60
    assert recipe.weather.flood is not None and recipe.weather.snow is None
    # What was set comes back with the effect.
    again = edits.without_section("weather.smog").with_section("weather.smog").recipe()
    assert again == recipe
    assert without_weather(recipe).sections() == {}


def test_of_two_fields_that_exclude_each_other_the_older_gives_way():
    edits = Edits("dense-fog").with_values({"weather.smog.extinction_per_m": "0.1"})
    with pytest.raises(RecipeError, match="keep one of them"):
        edits.recipe()
    others = ("weather.smog.scale_height_m", "weather.smog.visibility_m")
    smog = edits.without_conflict("weather.smog.extinction_per_m", others).recipe().weather.smog
    assert smog is not None and (smog.extinction_per_m, smog.visibility_m) == (0.1, None)
    assert Edits("clear").without_conflict("seed", others) == Edits("clear")


def test_held_weather_is_that_of_another_time_and_stays_so_when_it_is_saved():
    scene = open_fake("fake:street")
    text = "weather: {clock: {speed: 10}, smog: {visibility_m: {timeline: [[0, 10], [3, 70]]}}}"
    recipe = parse_recipe(text, source="page", name="page").resolve(0)
    camera = scene.frames[3].cameras["front"]
    held = hold_weather(recipe, scene, camera, 0.1)
    times = scene_times(scene)
    assert held.weather.smog is not None and held.timelines == ()
    assert held.weather.smog.visibility_m == pytest.approx(30)
    assert held.at(times, camera.timestamp_ns) is held
    assert held.weather_time_s(times, camera.timestamp_ns) == pytest.approx(1)
    saved = parse_recipe(dump_recipe(held), source="saved").resolve(0)
    assert saved == held and saved.at(times, camera.timestamp_ns) == held
    clear = without_weather(recipe)
    assert clear.at(times, camera.timestamp_ns) is clear


def test_a_saved_recipe_reads_back_with_its_files_and_replaces_none(tmp_path):
    for blue in (40, 200):
        photo = tmp_path / "uploads" / "photo.png"
        photo.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(photo), np.random.default_rng(0).integers(0, blue, (9, 9, 3), np.uint8))
        edits = Edits("clear", folder=tmp_path).with_values({
            "style": '{"image": "uploads/photo.png"}', "render.scale": "0.5",
        })  # fmt: skip
        recipe, path = edits.recipe(), unused_path(tmp_path, "mood", ".yaml").with_suffix(".yaml")
        save_recipe(recipe, path)
        assert load_recipe(path).resolve(0).hash == recipe.hash
    assert sorted(p.name for p in tmp_path.glob("*.yaml")) == ["mood-2.yaml", "mood.yaml"]
    assert load_recipe(tmp_path / "mood.yaml").resolve(0).style is not None


# ---- Cameras -------------------------------------------------------------------------------------


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_a_window_shows_a_cameras_pixels_where_its_own_pinhole_sees_them(aspect):
    own = Camera("off", 160, 90, 80.0, 82.0, 70.0, 50.0, torch.eye(4, dtype=torch.float64))
    place = place_in_window(own, aspect)
    (width, height), tan = place.size, math.tan(place.fov_rad / 2)
    for u, v in ((0, 0), (160, 0), (0, 90), (160, 90), (70, 50)):
        x, y = (u - own.cx) / own.fx, (v - own.cy) / own.fy
        across, down = (x / (tan * aspect) + 1) * width / 2, (y / tan + 1) * height / 2
        assert abs(across - (u + place.left)) <= 1 and abs(down - (v + place.top)) <= 1
    assert min(place.left, place.top) >= 0
    assert place.left + 160 <= width and place.top + 90 <= height


def test_a_flight_starts_with_the_recorded_cameras_pixels_and_pose():
    scene = open_street()
    own = scene.frames[0].cameras["front"]
    pose = own.world_from_camera
    from augment.scene.geometry import quat_from_rotmat

    wxyz = quat_from_rotmat(pose[:3, :3]).tolist()
    fov = 2 * math.atan(own.height / 2 / own.fy)
    free = free_camera(own, wxyz, pose[:3, 3].tolist(), fov, own.width / own.height)
    assert (free.width, free.height) == (own.width, own.height)
    assert free.fx == pytest.approx(own.fx) and free.timestamp_ns == own.timestamp_ns
    torch.testing.assert_close(free.camera_from_world, own.camera_from_world)
    torch.testing.assert_close(invert_rigid(free.camera_from_world), pose)


# ---- Pages ---------------------------------------------------------------------------------------


def rendered(folder: Path, command: str) -> np.ndarray:
    """What a command line of the page writes."""
    words = shlex.split(command)[1:]
    words[words.index("--out") + 1] = str(folder)
    assert main([*words, "--no-sheet", "--no-cache"]) == 0
    (image,) = folder.glob("*/*/images/*/*.png")
    return cv2.imread(str(image))[..., ::-1]


def command_of(page: PageClient, begins: str) -> str:
    """The command that the page shows, once it begins so."""
    import html
    import re

    def look() -> str | None:
        found = re.search(r"<textarea[^>]*>(.*?)</textarea>", page.status(), re.DOTALL)
        text = html.unescape(found[1]) if found else ""
        return text if text.startswith(begins) else None

    return page.wait_for(look, begins)


@pytest.mark.long
def test_the_picture_at_rest_is_the_one_that_render_writes(tmp_path):
    edits = Edits("clear", SCALE, folder=tmp_path / "views")
    with served(edits) as (viewer, url), PageClient(url) as page:
        page.rest(after=0)
        count = len(page.pictures)
        page.set("preset", "dense-fog")
        page.set("visibility_m", 40.0)
        shown = page.rest(after=count)
        recipe = dataclasses.replace(edits, source="dense-fog").with_values(
            {"weather.smog.visibility_m": "40.0"}
        ).recipe()  # fmt: skip
        camera = viewer.scene.frames[0].cameras["front"]
        assert np.array_equal(shown, render_view(viewer.scene, camera, recipe).rgb)
        copied = command_of(page, "climategs render dense-fog")
        page.set("name", "mine")
        page.press("Save picture")
        saved = command_of(page, f"climategs render {tmp_path}")
        written = cv2.imread(str(tmp_path / "views" / "mine.png"))[..., ::-1]
    assert np.array_equal(written, shown)
    assert np.array_equal(rendered(tmp_path / "copied", copied), shown)
    assert np.array_equal(rendered(tmp_path / "saved", saved), shown)
    assert load_recipe(tmp_path / "views" / "mine.yaml").resolve(0).hash != recipe.hash  # its name


@pytest.mark.long
def test_a_page_holds_the_weather_of_another_time_and_saves_it(tmp_path):
    path = tmp_path / "clearing.yaml"
    path.write_text(
        "weather: {smog: {visibility_m: {timeline: [[0, 20], [1, 300]], times: share}}}"
    )
    edits = Edits(str(path), SCALE, folder=tmp_path / "views")
    with served(edits) as (viewer, url), PageClient(url) as page:
        scene = viewer.scene
        camera = scene.frames[0].cameras["front"]
        first = page.rest(after=0)
        assert np.array_equal(first, render_view(scene, camera, edits.recipe()).rgb)
        assert "Changes over time: weather.smog.visibility_m" in page.status()
        count = len(page.pictures)
        page.set("time of the weather/at [%]", 100.0)
        page.set("time of the weather/hold", True)
        shown = page.rest(after=count)
        held = hold_weather(edits.recipe(), scene, camera, scene_times(scene).duration_s)
        assert np.array_equal(shown, render_view(scene, camera, held).rgb)
        assert not np.array_equal(shown, first)
        command_of(page, "# weather of another time: save the recipe first")
        page.press("Save picture")
        saved = command_of(page, f"climategs render {tmp_path}")
    assert np.array_equal(rendered(tmp_path / "saved", saved), shown)


@pytest.mark.long
def test_a_flight_is_repeated_by_the_command_line(tmp_path):
    edits = Edits("clear", SCALE, folder=tmp_path)
    with served(edits) as (_, url), PageClient(url) as page:
        page.rest(after=0)
        count = len(page.pictures)
        page.move(position=[2.0, 0.5, 2.5], look_at=[12.0, 0.0, 1.0])
        assert page.picture("while moving", after=count).shape[0] < 100
        shown = page.rest(after=count)
        page.press("Save picture")
        saved = command_of(page, f"climategs render {tmp_path}")
    picture = cv2.imread(str(tmp_path / "my-weather.png"))[..., ::-1]
    assert "--camera-path" in saved and np.array_equal(rendered(tmp_path / "out", saved), picture)
    # Shown before its pose went through a file.
    assert np.abs(shown.astype(int) - picture).mean() < 0.1


@pytest.mark.long
def test_pages_are_apart_errors_stay_on_their_page_and_closed_ones_are_forgotten(tmp_path, dust):
    with served(Edits("clear", SCALE, folder=tmp_path)) as (viewer, url), PageClient(url) as one:
        with PageClient(url, (320, 180)) as two:
            clear, count = two.rest(after=0), len(one.pictures)
            one.rest(after=0)
            one.set("more effects/dust/on", True)
            one.set("more effects/dust/half_m", 5.0)
            dusty = one.rest(after=count)
            assert np.abs(dusty.astype(int) - clear).mean() > 10
            assert two.widgets["more effects/dust/on"][0]["value"] is False
            one.set("flood", True)
            one.set("more of flood/waves/components", "[{")
            one.wait_for(lambda: "flood.waves.components" in one.status(), "the refusal")
            one.set("render/base", "recorded")  # the street has no photos
            one.press("Undo all changes")
            one.set("render/base", "recorded")
            one.wait_for(lambda: "SceneError" in one.status(), "the scene's refusal")
            count = len(one.pictures)
            one.press("Undo all changes")
            assert np.array_equal(one.rest(after=count), clear)
            assert len(viewer.pages) == 2
        one.wait_for(lambda: len(viewer.pages) == 1, "the other page to go")
        count = len(one.pictures)
        one.set("frame", 1)
        assert not np.array_equal(one.rest(after=count), clear)


class SlowDust(DustEffect):
    """Dust of which a picture of the whole size waits until it may go on."""

    def __init__(self, height: int) -> None:
        self.height, self.begun, self.may_end = height, threading.Event(), threading.Event()

    def edit_image(self, own, drawn, camera):
        if camera.height == self.height:
            self.begun.set()
            assert self.may_end.wait(60)
        return super().edit_image(own, drawn, camera)


@pytest.mark.long
def test_a_picture_at_rest_is_given_up_once_something_else_is_asked_for(tmp_path):
    edits = Edits("clear", SCALE, folder=tmp_path)
    with served(edits) as (viewer, url), PageClient(url, (320, 180)) as page:
        count = len(page.rest(after=0)) and len(page.pictures)
        slow = SlowDust(round(SCALE * viewer.scene.frames[0].cameras["front"].height))
        effects.add_effect(slow)
        try:
            (open_page,) = viewer.pages
            open_page.edit(edits.with_section("weather.dust"))
            assert slow.begun.wait(60)
            open_page.edit(edits)  # without dust
            slow.may_end.set()
            page.rest(after=count)
        finally:
            slow.may_end.set()
            effects.remove_effect("dust")
    kinds = [message["format"] for _, message in page.pictures[count:]]
    assert kinds.count("png") == 1 and kinds[-1] == "png"  # the dusty one is not among them


class SettlingDust(DustEffect):
    """Dust that takes steps to settle, in each of which it waits to be told to go on."""

    def __init__(self) -> None:
        self.steps, self.begun, self.ended = threading.Semaphore(0), 0, 0

    def edit_scene(self, own, layers, camera):
        self.begun += 1
        with counted_steps("settling dust", 2) as advance:
            for _ in range(2):
                assert self.steps.acquire(timeout=60)
                advance()
        self.ended += 1
        return super().edit_scene(own, layers, camera)


@pytest.mark.long
def test_a_preparation_is_told_step_by_step_and_given_up_once_nobody_wants_its_effect(tmp_path):
    edits = Edits("clear", SCALE, folder=tmp_path)
    with served(edits) as (viewer, url), PageClient(url, (320, 180)) as page:
        clear = page.rest(after=0)
        dust = SettlingDust()
        effects.add_effect(dust)
        try:
            (open_page,) = viewer.pages
            said, pictures = len(page.said), len(page.pictures)

            def wait_for_words(words: str) -> None:
                page.wait_for(lambda: any(words in text for text in page.said[said:]), words)

            open_page.edit(edits.with_section("weather.dust"))
            wait_for_words("Picture not of this recipe yet")
            wait_for_words("settling dust, step 0 of 2")
            dust.steps.release()
            wait_for_words("settling dust, step 1 of 2")
            assert "at rest" not in "".join(page.said[said:])
            assert len(page.pictures) == pictures
            # Another amount of dust has to settle, too; without dust nobody needs it.
            thick = edits.with_section("weather.dust").with_values({"weather.dust.half_m": "5"})
            open_page.edit(thick)
            dust.steps.release(5)
            page.rest(after=pictures)
            wait_for_words("at rest")
            assert dust.begun == dust.ended == 3  # the first, and both pictures of the second
            open_page.edit(edits.with_section("weather.dust"))
            page.wait_for(lambda: dust.begun == 4, "the dust to settle again")
            said, pictures = len(page.said), len(page.pictures)
            open_page.edit(edits)
            dust.steps.release()
            assert np.array_equal(page.rest(after=pictures), clear)
            assert dust.ended == 3
        finally:
            dust.steps.release(100)
            effects.remove_effect("dust")


@pytest.mark.long
def test_a_flight_out_of_what_was_recorded_is_told_until_it_ends(tmp_path):
    with served(Edits("clear", SCALE, folder=tmp_path)) as (_, url), PageClient(url) as page:
        page.rest(after=0)
        assert "Outside of what was recorded" not in page.status()
        page.move(position=[2.0, 0.5, 9.0], look_at=[12.0, 0.0, 1.0])
        page.wait_for(lambda: "Outside of what was recorded" in page.status(), "the warning")
        page.press("Back to the camera")
        page.wait_for(lambda: "Outside of what was recorded" not in page.status(), "its end")


@pytest.mark.long
def test_what_lies_over_the_picture_and_in_place_of_it(tmp_path):
    edits = Edits("fresh-snow", folder=tmp_path)
    with served(edits, LABELLED_STREET) as (viewer, url), PageClient(url) as page:
        snow = page.rest(after=0)
        for label in ("boxes", "LiDAR", "cameras"):
            page.set(f"drawn over the picture/{label}", True)
        others = [f"/cameras/{name}" for name in viewer.scene.camera_names if name != "front"]
        wanted = {"/boxes", "/lidar", *others}
        page.wait_for(lambda: wanted <= page.nodes, "what lies over the picture")
        assert "/cameras/front" not in page.nodes  # which the window looks out of
        assert page.pictures[-1][1]["depth_data"] is not None
        page.set("drawn over the picture/LiDAR", False)
        page.wait_for(lambda: "/lidar" not in page.nodes, "the returns to go")
        seen = [snow]
        for shows in ("depth", "classes", "instances", "splat ids", "mask of snow"):
            count = len(page.pictures)
            page.set("shows", shows)
            seen.append(page.rest(after=count))
            apart = (np.abs(seen[-1].astype(int) - other).mean() for other in seen[:-1])
            assert min(apart) > 1, shows
        count = len(page.pictures)
        page.set("shows", "picture")
        page.set("before and after/split", True)
        both = page.rest(after=count)
        middle = both.shape[1] // 2
        assert np.array_equal(both[:, middle + 2 :], snow[:, middle + 2 :])
        assert not np.array_equal(both[:, : middle - 2], snow[:, : middle - 2])
        count = len(page.pictures)
        page.set("play", True)
        page.wait_for(lambda: page.widgets["frame"][0]["value"] == 1, "the next frame")
        page.press("Measure the tiers on this view")
        page.wait_for(
            lambda: any("<td>reference</td>" in str(w) for ws in page.widgets.values() for w in ws),
            "the tiers",
        )


@pytest.mark.long
def test_a_photo_and_a_recipe_are_uploaded_and_saved(tmp_path):
    colors = np.random.default_rng(0).integers(0, 255, (20, 20, 3)) * [1.0, 0.6, 0.2]
    photo = cv2.imencode(".png", colors.astype(np.uint8))[1].tobytes()
    edits = Edits("clear", SCALE, folder=tmp_path / "views")
    with served(edits) as (_, url), PageClient(url) as page:
        clear, count = page.rest(after=0), len(page.pictures)
        page.set("style (colours)", True)
        page.upload("more of style/upload image", "../../warm photo.png", photo)
        warm = page.rest(after=count)
        assert np.abs(warm.astype(int) - clear).mean() > 2
        assert "save the recipe first" in page.status()
        page.press("Save recipe")
        saved = command_of(page, f"climategs render {tmp_path}")
        assert np.array_equal(rendered(tmp_path / "out", saved), warm)
        count = len(page.pictures)
        page.upload("Open a recipe", "fog.yaml", b"weather: {smog: {visibility_m: 20}}")
        assert np.abs(page.rest(after=count).astype(int) - clear).mean() > 5
        page.upload("Open a recipe", "fog.yaml", b"weather: {smoke: 1}")
        page.wait_for(lambda: "weather.smoke" in page.status(), "the refusal")
    assert sorted(p.name for p in (tmp_path / "views" / "opened").iterdir()) == [
        "fog-2.yaml", "fog.yaml",
    ]  # fmt: skip
    assert [p.name for p in (tmp_path / "views" / "uploads").iterdir()] == ["warm_photo.png"]


@pytest.mark.long
def test_a_page_that_takes_nothing_holds_up_no_other_and_other_sites_get_none(tmp_path):
    with served(Edits("clear", SCALE, folder=tmp_path)) as (viewer, url), PageClient(url) as page:
        page.rest(after=0)
        with pytest.raises(InvalidStatus, match="403"):
            PageClient(url, origin="http://elsewhere.example")
        assert len(viewer.pages) == 1
        deaf = PageClient(url)
        deaf.wait_for(lambda: len(deaf.pictures), "a picture")
        deaf.stop_listening()
        for step in range(60):
            deaf.move(position=[0.1 * step, 0.0, 2.0], look_at=[20.0, 0.0, 1.0])
            page.move(position=[0.1 * step, 1.0, 2.0], look_at=[20.0, 0.0, 1.0])
            time.sleep(0.02)
        count = len(page.pictures)
        page.move(position=[0.0, 0.0, 2.0], look_at=[20.0, 0.0, 1.0])
        assert page.rest(after=count).shape[0] > 50
        deaf.close()


@pytest.mark.long
def test_an_output_is_looked_through_by_its_numbers(tmp_path):
    out = tmp_path / "out"
    where = ["--scene", SMALL_STREET, "--cameras", "front", "--scale", str(SCALE), "--no-cache"]
    sets = ["--set", "weather.smog.visibility_m={uniform: [20, 80]}", "--variants", "2"]
    assert main(["render", "dense-fog", *where, *sets, "--out", str(out), "--no-sheet"]) == 0
    assert main(["render", "clear", *where, "--out", str(out), "--no-sheet"]) == 0
    output = find_output(str(out))
    assert output is not None and find_output(str(tmp_path)) is None
    viewer = OutputViewer(output)
    images = {(row["variant"], row["frame"]): viewer.picture(row, "image") for row in viewer.rows}
    assert len(images) == 6
    own = (192, 108)
    with serve(import_viser(), viewer, "127.0.0.1", 0) as url, PageClient(url, own) as page:
        variants = viewer.values("variant")
        page.wait_for(lambda: page.pictures, "a picture")
        for variant in variants:
            count = len(page.pictures)
            page.set("variant", variant)
            page.set("frame", 1)
            shown = page.rest(after=count) if variant != variants[0] else None
            assert shown is None or np.array_equal(shown, images[variant, 1])
        (name,) = (n for n in viewer.numbers if n == "smog_extinction_per_m")
        least, middle, most = viewer.values(name)
        assert least == 0
        page.set(f"only images with/{name}", [(middle + most) / 2, most])
        page.wait_for(lambda: len(page.widgets["variant"][0]["options"]) == 1, "the thickest")
        count = len(page.pictures)
        page.set("shows", "depth")
        assert page.rest(after=count).std() > 10


HOSTILE = "{(globalThis.PWNED = 1)} <img src=x onerror=globalThis.PWNED=1> | ` &lt; \u202e \x00"


def hostile_output(out: Path) -> Path:
    """An output whose manifest has code in every text that it may have, and numbers without end."""
    texts = ("source", "base", "surface", "lidar_note", "style", "quality", "settings", "recipe",
             "trajectory", "version", "backend", "message")  # fmt: skip
    own = dict.fromkeys(texts, HOSTILE)
    rows = [make_row(frame=0), make_row(frame=1, smog_extinction_per_m=0.5)]
    write_output(out, rows)
    numbers = {"flood_level_m": 1e308, "snow_depth_m": 5e-324}
    rows[1] |= {name: -value for name, value in numbers.items()}
    rows = [row | own | {"scene": HOSTILE, "variant": name, "camera": ""} | numbers
            for row, name in zip(rows, ("(none)", HOSTILE), strict=True)]  # fmt: skip
    write_manifest(out, rows_to_table(rows))
    return out


def test_what_a_manifest_says_is_shown_letter_for_letter(tmp_path):
    output = find_output(str(hostile_output(tmp_path / "out")))
    assert output is not None
    viewer = OutputViewer(output)
    assert viewer.numbers == ["smog_extinction_per_m"]
    with serve(import_viser(), viewer, "127.0.0.1", 0) as url, PageClient(url) as page:
        page.wait_for(lambda: page.pictures, "a picture")
        page.set("left of the line", page.widgets["left of the line"][0]["options"][1])
        page.set("variant", page.widgets["variant"][0]["options"][1])
        page.set("frame", 1)
        page.wait_for(lambda: "2 images" in page.status(), "the picture")
        widgets = [widget for same in page.widgets.values() for widget in same]
        assert not any("_markdown" in widget for widget in widgets)
        shown = page.status() + "".join(widget.get("content") or "" for widget in widgets)
    assert "<img" not in shown and "&lt;img src=x onerror" in shown
    assert "\u202e" not in shown and "\\u202e" in shown


def test_files_of_an_output_that_are_none_are_said_and_not_waited_for(tmp_path):
    rows = [make_row(frame=number) for number in range(4)]
    write_output(tmp_path, rows)
    pipe, loop, large, wrong = (tmp_path / row["image_path"] for row in rows)
    for path in (pipe, loop):
        path.unlink()
    os.mkfifo(pipe)
    loop.symlink_to(loop.name)
    data = bytearray(large.read_bytes())
    data[16:24] = struct.pack(">II", 2**20, 2**20)
    large.write_bytes(data)
    wrong.write_bytes(b"no image")
    viewer = OutputViewer(open_store(str(tmp_path)))
    said = []
    for row in viewer.rows:
        with pytest.raises(OutputError, match="cannot read") as raised:
            viewer.picture(row, "image")
        said.append(str(raised.value))
    assert "a pipe" in said[0] and "1048576 x 1048576 pixels" in said[2]


# ---- The command ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--host", "203.0.113.7"], "no address of this machine"),
        (["--recipe", "clera"], "clear"),
        (["--set", "weather.smog.visibility=3"], "visibility_m"),
        (["--port", "70000"], "port"),
    ],
)
def test_what_cannot_be_viewed_is_refused_before_a_page_opens(options, why, capsys):
    uri = "procedural:street?seed=3&frames=1&gaussians=60000&parked=0&moving=0&pedestrians=0"
    assert main(["view", uri, *options]) == 2
    assert why in capsys.readouterr().err


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ClimateGSError, match=r"pip install 'climategs\[view\]'"):
        import_viser()


def test_help_loads_neither_torch_nor_viser():
    code = (
        "import sys, tools.cli\n"
        "try: tools.cli.main(['view', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'viser'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
