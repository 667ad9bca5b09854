"""Files that a recipe names: where they may lie, what stands for them, and when they change."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.files import digest_of, read_files, with_digest
from recipes.load import dump_recipe, load_recipe, parse_recipe
from recipes.schema import Recipe
from recipes.style import Style


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recipe's folder, beside a file that is none of its business."""
    inside = tmp_path / "recipes"
    (inside / "looks").mkdir(parents=True)
    (inside / "sunset.jpg").write_bytes(b"an image")
    (inside / "looks" / "sky.png").write_bytes(b"a mask")
    (inside / "net.safetensors").write_bytes(b"a network")
    (tmp_path / "secret.jpg").write_bytes(b"an image")
    return inside


def write(folder: Path, style: str) -> Path:
    path = folder / "warm.yaml"
    path.write_text(f"version: 1\nstyle:\n  strength: 0.5\n  {style}\n")
    return path


def problem(folder: Path, style: str) -> str:
    with pytest.raises(RecipeError) as caught:
        load_recipe(write(folder, style))
    (text,) = caught.value.problems
    assert text.startswith(f"{folder}/warm.yaml:4: style.")
    return text


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_a_file_is_found_from_the_recipes_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder, "image: looks/../sunset.jpg\n  mask: looks/sky.png")
    expected = sha(f"image {sha(b'an image')}\nmask {sha(b'a mask')}\n".encode())
    monkeypatch.chdir(folder.parent)
    for named in (folder / "warm.yaml", "recipes/warm.yaml"):
        style = load_recipe(named).resolve(0).style
        assert style is not None and style.digest == expected
        assert style.image is not None and Path(style.image).is_absolute()
        assert Path(style.image).read_bytes() == b"an image" and style.name == "sunset.jpg"
    monkeypatch.chdir(folder)
    assert load_recipe("warm.yaml").resolve(0).style == style


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("/etc/hostname", "must be a path from the recipe's folder; put the file beside the rec"),
        ("C:/sunset.jpg", "must be a path from the recipe's folder"),
        ("'\\\\server\\x.jpg'", "must be a path from the recipe's folder"),
        ("looks\\sky.png", "must have / between folders"),
        ("../secret.jpg", "leads out of the recipe's folder; put the file beside the recipe, in "),
        ("looks/../../secret.jpg", "leads out of the recipe's folder"),
        ("../recipes/sunset.jpg", "leads out of the recipe's folder"),
        ("sunst.jpg", "; did you mean sunset.jpg?"),
        ("sunset.jpg/x", "there is no such file in "),
        ("nowhere/sunset.jpg", "; put the file beside the recipe or below it"),
        ("looks", "is a folder, not a file"),
        (".", "is a folder, not a file"),
        ('"a\\0b"', "cannot be found: "),
        ("x" * 300, "cannot be"),
    ],
)
def test_other_files_are_refused(folder: Path, name: str, message: str) -> None:
    assert message in problem(folder, f"image: {name}")


def test_links_may_not_lead_out(folder: Path) -> None:
    (folder / "out.jpg").symlink_to(folder.parent / "secret.jpg")
    (folder / "up").symlink_to(folder.parent)
    (folder / "circle.jpg").symlink_to("circle.jpg")
    (folder / "in.jpg").symlink_to("sunset.jpg")
    for name in ("out.jpg", "up/secret.jpg"):
        said = problem(folder, f"image: {name}")
        assert f"leads through a link to {folder.parent}/secret.jpg, out of the recipe's" in said
    assert "cannot be" in problem(folder, "image: circle.jpg")
    assert load_recipe(write(folder, "image: in.jpg")).resolve(0).style is not None


def test_a_folder_reached_through_a_link_is_a_folder(folder: Path) -> None:
    (folder.parent / "alias").symlink_to(folder)
    write(folder, "image: sunset.jpg")
    recipe = load_recipe(folder.parent / "alias" / "warm.yaml").resolve(0)
    assert recipe.hash == load_recipe(folder / "warm.yaml").resolve(0).hash


def test_all_options_are_looked_for_and_all_is_said_at_once(folder: Path) -> None:
    path = write(folder, "image: {choice: [sunset.jpg, dawn.jpg]}\n  checkpoint: nut.safetensors")
    with pytest.raises(RecipeError) as caught:
        load_recipe(path)
    first, second = caught.value.problems
    assert "style.image.choice[1] = 'dawn.jpg': there is no such file" in first
    assert "style.checkpoint = 'nut.safetensors': there is no such file" in second
    assert second.endswith("; did you mean net.safetensors?")


def test_pipes_and_large_files_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(folder / "pipe.jpg")
    assert "cannot be read: a pipe or device, not a regular file" in problem(
        folder, "image: pipe.jpg"
    )
    with (folder / "huge.jpg").open("wb") as file:
        file.truncate(513 * 2**20)  # takes no room on the disk
    assert "holds 513 MiB, more than the 512 MiB" in problem(folder, "image: huge.jpg")


def test_a_file_without_permission(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = os.open

    def refuse(path, *options):
        if Path(path).suffix == ".jpg":
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *options)

    path = write(folder, "image: sunset.jpg")
    monkeypatch.setattr(os, "open", refuse)  # permissions themselves do not bind root
    with pytest.raises(RecipeError, match=r"style.image = 'sunset.jpg': cannot be read: Perm"):
        load_recipe(path)


def test_a_text_that_is_no_file_names_none(folder: Path) -> None:
    with pytest.raises(RecipeError, match="in no file, so there is no folder to look in"):
        parse_recipe("style: {image: sunset.jpg}", source="text")


def test_a_file_that_goes_after_loading_is_named(folder: Path) -> None:
    template = load_recipe(write(folder, "image: sunset.jpg"))
    (folder / "sunset.jpg").unlink()
    with pytest.raises(
        RecipeError, match=r"variant 0: style.image = 'sunset.jpg': there is no suc"
    ):
        template.resolve(0)


def test_a_given_digest_is_checked(folder: Path) -> None:
    digest = digest_of({"image": sha(b"an image")})
    path = write(folder, f"image: sunset.jpg\n  digest: {digest}")
    style = load_recipe(path).resolve(0).style
    assert style is not None and style.digest == digest
    (folder / "sunset.jpg").write_bytes(b"another one")
    with pytest.raises(RecipeError) as caught:
        load_recipe(path).resolve(0)
    assert "warm.yaml" in str(caught.value) and digest in str(caught.value)
    assert "the file has changed since" in str(caught.value)
    with pytest.raises(RecipeError, match="changed since"):
        read_files(style)


def test_the_hash_is_of_what_the_files_hold(folder: Path, tmp_path: Path) -> None:
    here = load_recipe(write(folder, "image: sunset.jpg\n  mask: looks/sky.png")).resolve(0)
    there = tmp_path / "elsewhere"
    shutil.copytree(folder, there)
    (there / "sunset.jpg").rename(there / "evening.jpg")
    moved = load_recipe(write(there, "image: evening.jpg\n  mask: looks/sky.png")).resolve(0)
    assert moved.hash == here.hash and moved != here
    hashes = {here.hash}
    for style in ("image: evening.jpg", "image: looks/sky.png\n  mask: evening.jpg"):
        hashes.add(load_recipe(write(there, style)).resolve(0).hash)
    (there / "looks" / "sky.png").write_bytes(b"a mesk")
    hashes.add(
        load_recipe(write(there, "image: evening.jpg\n  mask: looks/sky.png")).resolve(0).hash
    )
    assert len(hashes) == 4


def test_recipes_made_in_python_get_their_digest(folder: Path) -> None:
    image, net = str(folder / "sunset.jpg"), str(folder / "net.safetensors")
    bare = Recipe(style=Style(image=image, method="gscm", checkpoint=net))
    full = with_digest(bare)
    assert full.style is not None and bare.style is not None
    expected = digest_of({"image": sha(b"an image"), "checkpoint": sha(b"a network")})
    assert full.style.digest == expected and full.style.image == image
    assert full.hash != bare.hash and with_digest(full) == full
    assert read_files(full.style) == {"image": b"an image", "checkpoint": b"a network"}
    for plain in (Recipe(), Recipe(style=Style(preset="dusk"))):
        assert with_digest(plain) is plain
    (folder / "net.safetensors").write_bytes(b"another")
    with pytest.raises(RecipeError, match="one of the files has changed since"):
        with_digest(full)
    (folder / "sunset.jpg").unlink()
    with pytest.raises(RecipeError, match=r"recipe recipe, variant 0: style.image = .* no such"):
        with_digest(bare)


def test_what_is_written_from_the_folder_reads_back(folder: Path) -> None:
    recipe = load_recipe(write(folder, "image: sunset.jpg")).resolve(0)
    assert recipe.style is not None
    named = recipe.style.model_copy(update={"image": "sunset.jpg"})
    (folder / "numbers.yaml").write_text(
        dump_recipe(recipe.model_copy(update={"style": named})), encoding="utf-8"
    )
    assert load_recipe(folder / "numbers.yaml").resolve(0) == recipe
    assert Recipe.model_validate(recipe.model_dump()) == recipe
