"""Masks of the recording car that a user states: files, URIs, digests."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.base import expand_job_scenes, open_scene
from adapters.ego_masks import read_ego_masks, with_ego_masks
from adapters.scene_cache import scene_digest
from adapters.training_views.views import RecordedViews
from augment.errors import AdapterError, ClimateGSError
from augment.photo.own_car import own_car_mask
from recipes.job import JobScene
from tests.adapters import drives
from tests.streets import SMALL_STREET
from tools.options import with_ego_masks_key

SIZE = (160, 120)
FRONT = drives.camera("front", 0, size=SIZE, focal_px=80.0)
LEFT = drives.camera("left", 0, size=SIZE, focal_px=80.0, rotation=drives.LEFT)
CAMERAS = {"front": FRONT, "left": LEFT}


def write(folder: Path, name: str, content: object) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / name
    if isinstance(content, np.ndarray):
        assert cv2.imwrite(str(path), content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(json.dumps(content))
    return path


BONNET = [[0, 100], [160, 100], [160, 120], [0, 120]]


def test_polygons_and_images_give_the_same_mask(tmp_path):
    image = np.zeros((120, 160), np.uint8)
    image[100:] = 255
    write(tmp_path / "a", "front.png", image)
    write(tmp_path / "a", "left.json", {"polygons": []})  # sees none of the car
    write(tmp_path / "a", "notes.txt", b"by hand")
    masks = read_ego_masks(tmp_path / "a", CAMERAS)
    assert list(masks) == ["front"]
    assert masks["front"][100:].all() and not masks["front"][:100].any()
    write(tmp_path / "b", "front.json", {"polygons": [BONNET]})
    # Polygons of OpenCV include the pixels on their border.
    polygon_mask = read_ego_masks(tmp_path / "b", CAMERAS)["front"]
    assert (polygon_mask != masks["front"]).sum() <= 160
    twice = {"size": [320, 240], "polygons": [[[2 * x, 2 * y] for x, y in BONNET]]}
    write(tmp_path / "c", "front.json", twice)
    assert np.array_equal(read_ego_masks(tmp_path / "c", CAMERAS)["front"], polygon_mask)
    far = {"polygons": [[[-1e6, 100], [1e6, 100], [1e6, 1e6], [-1e6, 1e6]]]}
    write(tmp_path / "d", "front.json", far)
    assert np.array_equal(read_ego_masks(tmp_path / "d", CAMERAS)["front"], polygon_mask)


REFUSED = {
    "front.png": (b"?", "cannot be decoded"),
    "front.json": ({"polygons": [[[0, 0], [1, 1]]]}, "polygons.0 .*at least 3"),
    "left.json": ({"polygons": [[[0, 0], [1, float("nan")], [2, 0]]]}, "polygons.0.1.1"),
    "left.png": (np.zeros((120, 100), np.uint8), "100x120 pixels.*160x120"),
    "fron.png": (np.zeros((120, 160), np.uint8), "mask of no camera; .*cameras are front, left"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unusable_masks_are_refused_by_name(tmp_path, name):
    content, message = REFUSED[name]
    write(tmp_path / "masks", name, content)
    with pytest.raises(AdapterError, match=message):
        read_ego_masks(tmp_path / "masks", CAMERAS)


def test_folders_without_a_clear_mask_are_refused(tmp_path):
    with pytest.raises(AdapterError, match=r"no such folder; expected .*front\.png.*front\.json"):
        read_ego_masks(tmp_path / "none", CAMERAS)
    (tmp_path / "empty").mkdir()
    with pytest.raises(AdapterError, match="holds no mask"):
        read_ego_masks(tmp_path / "empty", CAMERAS)
    for content in ({"polygon": []}, [], {"polygons": [BONNET], "size": [160, 50]}):
        write(tmp_path / "bad", "front.json", content)
        with pytest.raises(AdapterError, match=r"front\.json"):
            read_ego_masks(tmp_path / "bad", CAMERAS)
    write(tmp_path / "two", "front.json", {"polygons": [BONNET]})
    write(tmp_path / "two", "front.png", np.zeros((120, 160), np.uint8))
    with pytest.raises(AdapterError, match=r"front\.json and front\.png; keep one"):
        read_ego_masks(tmp_path / "two", CAMERAS)


@pytest.fixture
def scene(tmp_path):
    def cameras(frame):
        return {"front": dataclasses.replace(FRONT, timestamp_ns=frame * 100_000_000)}

    return drives.drive(tmp_path / "images", 2, cameras=cameras)


def test_a_scene_and_its_fit_take_stated_masks_first(scene, tmp_path):
    write(tmp_path / "masks", "front.json", {"polygons": [BONNET]})
    masked = with_ego_masks(scene, tmp_path / "masks")
    mask = own_car_mask(masked, scene.frames[0].cameras["front"])
    assert mask is not None and mask[101:].all() and not mask[:99].any()
    half = own_car_mask(masked, scene.frames[0].cameras["front"].scaled(0.5))
    assert half is not None and half[51:].all() and not half[:49].any()
    views = RecordedViews(masked, scale=0.5)
    assert views.ego_masks["front"][51:].all() and not views.ego_masks["front"][:49].any()
    none = with_ego_masks(scene, write(tmp_path / "no", "front.json", {"polygons": []}).parent)
    assert own_car_mask(none, scene.frames[0].cameras["front"]) is None
    assert RecordedViews(none, scale=0.5).ego_masks == {}


def test_a_uri_names_masks_which_its_digest_counts(tmp_path):
    masks = tmp_path / "masks"
    write(masks, "front.json", {"polygons": [BONNET]})
    street = SMALL_STREET
    scene = open_scene(f"{street}&ego_masks={masks}")
    assert scene.ego_masks is not None and list(scene.ego_masks) == ["front"]
    again = open_scene(scene.source)
    assert again.ego_masks is not None
    assert np.array_equal(again.ego_masks["front"], scene.ego_masks["front"])
    with pytest.raises(AdapterError, match="no such folder"):
        open_scene(f"{street}&ego_masks={tmp_path / 'none'}")
    assert with_ego_masks_key(street, None) == street
    assert with_ego_masks_key(street, masks).endswith(f"ego_masks={masks}")
    with pytest.raises(ClimateGSError, match="keep one"):
        with_ego_masks_key(f"{street}&ego_masks={masks}", masks)
    (entry,) = expand_job_scenes([JobScene(uri=f"{street}&ego_masks=masks")], tmp_path)
    assert entry.uri.endswith(f"ego_masks={masks}")


def test_other_masks_give_a_scene_another_digest(tmp_path):
    from tests.adapters.recording_files import write_as_recording

    masks = tmp_path / "masks"
    write_as_recording(tmp_path / "drive")
    write(masks, "front.json", {"polygons": [BONNET]})
    uri = f"recording:{tmp_path / 'drive'}?ego_masks={masks}"
    digest = scene_digest(uri)
    assert digest is not None and digest != scene_digest(f"recording:{tmp_path / 'drive'}")
    write(masks, "front.json", {"polygons": [BONNET[:3]]})
    assert scene_digest(uri) not in (None, digest)
