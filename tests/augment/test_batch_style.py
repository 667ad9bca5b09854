"""A job works out the maps of its styles once, and leaves what renders its images again."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from batch_scenes import (
    fake_render,
    make_camera,
    make_frame,
    make_maps,
    make_recipe,
    must_not_render,
    open_fake,
    style_render,
    tree_digest,
)

from augment.cameras import Frame
from augment.effects import Sharing, share_effects
from augment.effects.style import style as scene_maps
from augment.errors import OutputError, StyleError
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job, stored_names
from augment.memo import memo_of
from recipes.errors import RecipeError
from recipes.files import with_digest
from recipes.load import load_recipe
from recipes.schema import Recipe
from recipes.style import Style


class Searches(list):
    """Stands in for working out maps: lists (style, cameras) of every call.

    before: what to do at each call. The maps say how strong the style is and how many cameras.
    """

    before: Callable[[], None] = staticmethod(lambda: None)

    def __call__(self, scene, style, cameras):
        self.before()
        self.append((style, cameras))
        return make_maps(style.strength + (0 if cameras is None else 0.01 * len(cameras)))


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> Searches:
    found = Searches()
    monkeypatch.setattr(scene_maps, "_find_maps", found)
    return found


def styled(strength: float = 1.0, variant: int = 0, **style) -> Recipe:
    source = {} if "image" in style else {"preset": "dusk"}
    return make_recipe(variant=variant, style=Style(strength=strength, **source, **style))


def run(job: RenderJob, renderer=style_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


def reds(out: Path) -> dict[str, set[int]]:
    """The second pixel's red in the images of every variant."""

    def red(path: Path) -> int:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert image is not None
        return int(image[0, 1, 2])

    folders = (out / "street").glob("*-*")
    return {folder.name: set(map(red, folder.glob("images/*/*.png"))) for folder in folders}


def image_at(path: Path, colour: int = 90) -> str:
    """Writes a small picture: a sky over a ground."""
    rng = np.random.default_rng(colour)
    pixels = rng.integers(0, 60, (24, 32, 3), dtype=np.uint8) + np.uint8(colour)
    pixels[:8] += 60
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)
    return str(path)


def test_maps_are_found_once_for_all_images_before_any_file(searches, tmp_path: Path) -> None:
    searches.before = lambda: searches.append([p for p in tmp_path.rglob("*") if p.suffix])
    recipes = [styled(0.5), styled(0.5, 1), styled(0.25, 2), make_recipe("clear")]
    job = RenderJob("fake:street", recipes, tmp_path, frames=[1], cameras=["front"])
    result = run(job)
    assert result.written == 4 and result.timings["prepare"] > 0
    before, (first, cameras), _, (second, _) = searches
    assert before == [] and (first, second) == (recipes[0].style, recipes[2].style)
    assert cameras is None, "a selection does not count"
    found = reds(tmp_path)
    del found["clear-000"]
    assert found == {"fog-000": {50}, "fog-001": {50}, "fog-002": {25}}
    assert run(dataclasses.replace(job, frames=None, cameras=None)).written == 28
    assert reds(tmp_path)["fog-001"] == {50}


@pytest.mark.parametrize("style", [None, Style(preset="dusk", strength=0)])
def test_a_style_that_changes_nothing_needs_no_maps(searches, tmp_path: Path, style) -> None:
    searches.before = pytest.fail
    result = run(RenderJob("fake:street", [make_recipe(style=style)], tmp_path))
    assert result.written == 8


def test_a_camera_path_has_maps_of_its_own(searches, tmp_path: Path) -> None:
    """And the caller's scene goes on with its own cameras'."""
    scene, recorded = open_fake("fake:street"), make_frame(1)
    cameras = {"front": make_camera("front", recorded.timestamp_ns, 0.5)}
    path = [Frame(1, recorded.timestamp_ns, recorded.world_from_ego, cameras)]
    count = 9
    recipes = [styled(0.1 * (k + 1), k) for k in range(count)]
    load = {"scene_loader": lambda _uri: scene}
    run(RenderJob("fake:street", recipes, tmp_path / "path", camera_path=path), **load)
    assert reds(tmp_path / "path") == {f"fog-{k:03d}": {10 * k + 11} for k in range(count)}
    assert len(searches) == count and all(len(cameras) == 1 for _, cameras in searches)
    run(RenderJob("fake:street", recipes[:1], tmp_path / "own", frames=[0]), **load)
    assert reds(tmp_path / "own") == {"fog-000": {10}}


def test_maps_travel_with_all_their_bits(searches, tmp_path: Path) -> None:
    scene, other, recipe = *(open_fake("fake:street") for _ in range(2)), styled(1 / 3)
    share_effects(Sharing(scene, [recipe]))
    memo_of(other).update(pickle.loads(pickle.dumps(memo_of(scene).shared())))
    searches.before = pytest.fail
    again = scene_maps.style_maps(other, recipe.style)
    expected = make_maps(1 / 3)
    for name in ("splats", "sky", "picture"):
        assert torch.equal(getattr(again, name), getattr(expected, name))
    assert scene_maps.style_maps(other, recipe.style) is again, "what is made of it can be kept"


def test_a_style_that_cannot_be_used_leaves_all_as_it_was(searches, tmp_path: Path) -> None:
    def fails() -> None:
        raise StyleError("sunset.jpg is cut short")

    run(RenderJob("fake:street", [make_recipe()], tmp_path / "out", frames=[0]))
    before = tree_digest(tmp_path / "out")
    searches.before = fails
    image = image_at(tmp_path / "sunset.png")
    changed = with_digest(styled(image=image))
    image_at(tmp_path / "sunset.png", 91)
    for overwrite in (False, True):
        variant = 0 if overwrite else 1
        bad = {
            "is cut short": styled(1, variant),
            "no such file": styled(1, variant, image=str(tmp_path / "dawn.png")),
            "has changed since": changed.model_copy(update={"variant": variant}),
        }
        for message, recipe in bad.items():
            job = RenderJob("fake:street", [recipe], tmp_path / "out", overwrite=overwrite)
            with pytest.raises((StyleError, RecipeError), match=message):
                run(job)
            assert tree_digest(tmp_path / "out") == before


def test_the_manifest_says_the_style(searches, tmp_path: Path) -> None:
    image = image_at(tmp_path / "sunset.png")
    recipes = [make_recipe(), styled(0.5, 1), styled(2, 2, image=image, method="reinhard")]
    run(RenderJob("fake:street", recipes, tmp_path / "out", frames=[0], cameras=["front"]))
    table = read_manifest(tmp_path / "out")
    names = ("style", "style_method", "style_strength")
    assert [tuple(row[name] for name in names) for row in table.to_pylist()] == [
        (None, None, 0.0),
        ("dusk", "mkl", 0.5),
        ("sunset.png", "reinhard", 2.0),
    ]
    at = table.column_names.index("style")
    assert table.column_names[at : at + 2] == ["style", "style_method"]


def test_the_recipe_in_the_folder_renders_it_again(searches, tmp_path: Path) -> None:
    """Wherever the folder is taken, without the files that it was made from."""
    (tmp_path / "looks").mkdir()
    image_at(tmp_path / "looks" / "my sunset.png")
    image_at(tmp_path / "looks" / "masks" / "my sunset.png", 30)
    (tmp_path / "looks" / "fog.yaml").write_text(
        "weather: {smog: {visibility_m: 50}}\n"
        "style: {image: my sunset.png, mask: masks/my sunset.png, strength: {uniform: [0, 1]}}\n"
    )
    recipe = load_recipe(tmp_path / "looks" / "fog.yaml").resolve(2)
    run(RenderJob("fake:street", [recipe], tmp_path / "out"))
    (tmp_path / "out").rename(tmp_path / "taken")
    images = [p for p in (tmp_path / "looks").rglob("*.png")]
    contents = {p.read_bytes() for p in images}
    for path in images:
        path.unlink()
    folder = tmp_path / "taken" / "street" / "fog-002"
    kept = sorted((folder / "style").iterdir())
    assert len(kept) == 2 and {p.read_bytes() for p in kept} == contents
    again = load_recipe(folder / "recipe.yaml").resolve(0)
    assert again.hash == recipe.hash and again.style is not None
    assert Path(again.style.image or "").parent == folder / "style"
    run(RenderJob("fake:street", [again], tmp_path / "again"))
    assert tree_digest(tmp_path / "again" / "street" / "fog-002" / "images") == tree_digest(
        folder / "images"
    )
    # And the names are safe now: they stay.
    assert (tmp_path / "again" / "street" / "fog-002" / "recipe.yaml").read_bytes() == (
        folder / "recipe.yaml"
    ).read_bytes()
    # The job goes on in its own folder, and does not overwrite what it needs.
    (folder / "images" / "front" / "000001.png").unlink()
    assert run(RenderJob("fake:street", [again], tmp_path / "taken")).written == 1
    before = tree_digest(tmp_path / "taken")
    with pytest.raises(OutputError, match="copy the recipe and its files out of it first"):
        run(RenderJob("fake:street", [again], tmp_path / "taken", overwrite=True))
    assert tree_digest(tmp_path / "taken") == before


def test_files_keep_their_names_but_for_collisions() -> None:
    for files, names in (
        ({"image": "/a/x.png"}, ["x.png"]),
        ({"image": "x.png", "mask": "/b/x.png"}, ["x.png", "mask-x.png"]),
        ({"image": "mask-X.png", "mask": "b/mask-x.png"}, ["mask-X.png", "mask-mask-x.png"]),
        (
            {"image": "x", "mask": "b/x", "checkpoint": "c/mask-x", "method": "gscm"},
            ["x", "mask-x", "checkpoint-mask-x"],
        ),
    ):
        assert list(stored_names(Recipe(style=Style(**files))).values()) == [
            f"style/{name}" for name in names
        ]


def test_unsafe_names_become_safe_ones_and_then_stay() -> None:
    def stored(image: str) -> str:
        return stored_names(Recipe(style=Style(image=image)))["style.image"]

    for name in ("été 3.JPG", "..png", "-x.png", "a.b c", "a" * 200, "b" * 200 + ".png"):
        first = stored(f"/photos/{name}")
        assert first != f"style/{name}" and first.isascii() and " " not in first
        assert first.endswith((".JPG", ".png")) == name.endswith((".JPG", ".png"))
        assert len(first) < 140
        assert stored(f"/out/{first}") == first
        assert stored(f"/photos/x{name}") != first


def test_a_picture_under_another_name_is_the_same_style(searches, tmp_path: Path) -> None:
    """And the rows that were there say the new name, as all others do."""
    out = tmp_path / "out"
    first = styled(image=image_at(tmp_path / "a" / "sunset.png"))
    run(RenderJob("fake:street", [first], out, frames=[0]))
    second = styled(image=image_at(tmp_path / "b" / "evening.png"))
    result = run(RenderJob("fake:street", [second], out))
    assert (result.written, result.skipped) == (6, 2)
    assert set(read_manifest(out)["style"].to_pylist()) == {"evening.png"}
    other = styled(image=image_at(tmp_path / "c" / "evening.png", 50))
    with pytest.raises(OutputError, match="recipe hash there"):
        run(RenderJob("fake:street", [other], out), must_not_render)


def test_rows_from_before_styles_have_strength_zero(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    run(RenderJob("fake:street", [make_recipe()], tmp_path), fake_render)
    manifest = tmp_path / "manifest.parquet"
    old = pq.read_table(manifest).drop_columns(["style", "style_method", "style_strength"])
    pq.write_table(old, manifest)
    assert read_manifest(tmp_path)["style"].to_pylist() == [None] * 8
    run(RenderJob("fake:street", [make_recipe(variant=1)], tmp_path), fake_render)
    table = read_manifest(tmp_path)
    assert table["style_strength"].to_pylist() == [0.0] * 16
    assert table["style"].to_pylist() == table["style_method"].to_pylist() == [None] * 16


def test_the_librarys_own_style_does_not_depend_on_how_a_job_went(tmp_path: Path) -> None:
    """Real maps and real pictures, whole and in parts that search anew."""
    image, uri = image_at(tmp_path / "sunset.png", 150), "fake:street?frames=2"
    recipes = [styled(1, 0, image=image), styled(1, 1, image=image, applied_to="picture")]
    whole, parts, plain = (tmp_path / name for name in ("whole", "parts", "plain"))
    result = run(RenderJob(uri, recipes, whole), None)
    assert (result.written, result.failures) == (8, ())
    run(RenderJob(uri, recipes, parts, frames=[1], cameras=["front"]), None)
    assert run(RenderJob(uri, recipes, parts), None).skipped == 2
    assert tree_digest(parts) == tree_digest(whole)
    run(RenderJob(uri, [make_recipe()], plain), None)
    unstyled = tree_digest(plain / "street" / "fog-000" / "images")
    for variant in ("fog-000", "fog-001"):
        pictures = tree_digest(whole / "street" / variant / "images")
        assert not set(pictures.values()) & set(unstyled.values())
