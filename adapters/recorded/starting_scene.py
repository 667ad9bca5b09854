"""What reconstruction starts from: the scene of a recording, and what its sensors leave out.

Walls go on above the LiDAR's view, and the recording car's own body stands before some cameras.
"""

from __future__ import annotations

import dataclasses

import torch

from adapters.recorded.ego_body import ego_body
from adapters.recorded.views import RecordedViews
from adapters.recorded.wall_tops import wall_tops
from augment.scene import Gaussians, Scene


def starting_scene(scene: Scene, views: RecordedViews) -> Scene:
    """The scene with upper walls in its background and a body of the recording car for every
    camera that sees it, both from training views alone.
    """
    top_deg = views.facts["lidar_top_deg"]
    background = scene.background
    if top_deg is not None:  # without LiDAR nothing ends at its highest view
        background = _joined(background, wall_tops(scene, views, lidar_top_deg=top_deg))
    bodies = [ego_body(scene, name, mask, views) for name, mask in views.ego_masks.items()]
    actors = (*scene.actors, *(body for body in bodies if body is not None))
    return dataclasses.replace(scene, background=background, actors=actors)


def _joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """Both, at the first one's SH degree, which is not lower than the second's."""
    if len(second) == 0:
        return first
    sh = torch.zeros(len(second), first.sh.shape[1], 3)
    sh[:, : second.sh.shape[1]] = second.sh
    semantic = None
    if first.semantic is not None and second.semantic is not None:
        semantic = torch.cat([first.semantic, second.semantic])
    return Gaussians(
        means=torch.cat([first.means, second.means]),
        quats=torch.cat([first.quats, second.quats]),
        scales=torch.cat([first.scales, second.scales]),
        opacities=torch.cat([first.opacities, second.opacities]),
        sh=torch.cat([first.sh, sh]),
        semantic=semantic,
    )
