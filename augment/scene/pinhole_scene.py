"""Scenes whose cameras have lenses, with pinhole cameras that look the same way in their place.

Placement of snow and wet ground, trust, pruning and photos ask where cameras have been and what
they have seen. They know straight rays only.
"""

from __future__ import annotations

import dataclasses
import threading
from weakref import WeakKeyDictionary

from augment.memo import share_memo
from augment.scene.cameras import Frame
from augment.scene.pinhole_views import covering_camera
from augment.scene.scene import Scene


def pinhole_scene(scene: Scene) -> Scene:
    """Return the scene with a pinhole camera in place of each camera with a lens or a shutter.

    The result is the scene itself if all its cameras are pinholes. Otherwise it is made once, and
    shares the scene's memo, since nothing is computed with the cameras as they are. Where actors
    were moved, the scene as it was recorded has the same pinhole cameras.
    """
    recorded = None if scene.recorded is None else pinhole_scene(scene.recorded)
    with _lock:
        if scene in _scenes:
            return _scenes[scene] or scene
        frames = pinhole_frames(scene.frames)
        seen_frames = None if scene.seen_frames is None else pinhole_frames(scene.seen_frames)
        if recorded is not None and scene.recorded is not None:
            # `Scene.as_recorded` tells by identity that nothing but actors has changed.
            if scene.frames is scene.recorded.frames:
                frames = recorded.frames
            if scene.seen_frames is scene.recorded.seen_frames:
                seen_frames = recorded.seen_frames
        if frames is scene.frames and seen_frames is scene.seen_frames:
            _scenes[scene] = None
            return scene
        changed = dataclasses.replace(
            scene,
            frames=frames,
            seen_frames=seen_frames,
            lens_frames=scene.frames,
            recorded=recorded,
        )
        share_memo(scene, changed)
        share_memo(scene.as_recorded, changed.as_recorded)
        _scenes[scene] = changed
        return changed


# Scenes with pinhole cameras, by the scene with lenses; None by a scene that has pinholes only,
# since a scene that stood for itself would live for ever. For the same reason, they are not in the
# memo that both share.
_scenes: WeakKeyDictionary[Scene, Scene | None] = WeakKeyDictionary()
_lock = threading.Lock()


def pinhole_frames(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Return frames with pinhole cameras; the same tuple if they have no others.

    Args:
        frames: frames of any cameras; orthographic ones stay.
    """
    if all(
        camera.is_pinhole or camera.is_orthographic
        for frame in frames
        for camera in frame.cameras.values()
    ):
        return frames
    return tuple(
        dataclasses.replace(
            frame,
            cameras={
                name: camera if camera.is_orthographic else covering_camera(camera)
                for name, camera in frame.cameras.items()
            },
        )
        for frame in frames
    )
