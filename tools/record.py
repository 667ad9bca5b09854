"""`climategs record`: a COLMAP reconstruction becomes a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adapters.recording.from_colmap import record_colmap

if TYPE_CHECKING:
    from tools.cli import RecordOptions


def record_drive(options: RecordOptions) -> int:
    """Write the recording and print its size, its road and its scale. Return 0."""
    recording = record_colmap(
        options.model,
        options.images,
        options.out,
        fps=options.fps,
        camera_height_m=options.camera_height,
        positions=options.positions,
        keeps_lens=options.lens == "recorded",
    )
    road = recording.road
    print(
        f"{recording.frames} frames, {recording.images} images; "
        f"{recording.num_images_without_pose} have no pose, left out"
    )
    print(
        f"road: {road.points} points, half of them within {100 * road.residual:.1f} % of the "
        f"cameras' height of one plane, which is taken for level"
    )
    if recording.metres is None:
        print("metres are not known: give --camera-height or --positions")
    else:
        print(
            f"scale: {recording.metres:.4g} m a unit of COLMAP's; the cameras are "
            f"{recording.metres * road.height:.2f} m above the road"
        )
    if recording.residual_m is not None:
        print(f"positions: half of them within {recording.residual_m:.2f} m")
    print(f"recording: {options.out}")
    return 0
