"""Parts of pictures: captions, strips, colour maps and bars; files of pictures and videos."""

from __future__ import annotations

import itertools
import subprocess
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from augment.errors import OutputError
from augment.output.atomic import write_atomic, write_file_atomically
from tools.output import print_note

FONT = cv2.FONT_HERSHEY_SIMPLEX
CAPTION_PX = 42  # the height of the two lines under a picture, in pixels
GAP_PX = 8  # the white gap between two pictures, in pixels
Color = tuple[int, int, int]
# What browsers play, from its start on, in the colours of RGB. One thread and nothing of the moment
# or the version: the same frames give the same bytes.
H264 = (
    "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart -threads 1 -fflags +bitexact "
    "-flags:v +bitexact -vf scale=out_color_matrix=bt709:flags=accurate_rnd+bitexact "
    "-colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


def write(
    image: np.ndarray,
    text: str,
    x: float,
    y: float,
    *,
    size: float = 0.5,
    color: Color = (40, 40, 40),
    centred: bool = False,
    thickness: int = 1,
) -> None:
    """Write a text with its baseline at y and its left end, or its centre, at x."""
    if centred:
        x -= 0.5 * text_width(text, size, thickness)
    cv2.putText(image, text, (round(x), round(y)), FONT, size, color, thickness, cv2.LINE_AA)


def captioned(image: np.ndarray, title: str, text: str) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], with two lines of text below it."""
    caption = np.full((CAPTION_PX, image.shape[1], 3), 255, np.uint8)
    write(caption, title, 4, 17, size=0.48)
    write(caption, text, 4, 36, size=0.42, color=(110, 110, 110))
    return np.concatenate([image, caption])


def strip(panels: Sequence[np.ndarray]) -> np.ndarray:
    """Return pictures of one height side by side on white."""
    gap = np.full((panels[0].shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], 1)


def resized(image: np.ndarray, width: int, how: int) -> np.ndarray:
    """Resize a picture to another width, by one of OpenCV's interpolations."""
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=how)


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Return the width of a text, in pixels."""
    return cv2.getTextSize(text, FONT, size, thickness)[0][0]


def color_mapped(values: np.ndarray, color_map: int) -> np.ndarray:
    """Return colours of values [H, W] in [0, 1] (clamped) by a colour map, uint8 [H, W, 3]."""
    levels = (np.clip(values, 0, 1) * 255).round().astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, color_map), cv2.COLOR_BGR2RGB)


def color_bar(width: int, height: int, color_map: int) -> np.ndarray:
    """Return a colour bar, uint8 [H, W, 3]: 0 at the left, 1 at the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, width), (height, width))
    return color_mapped(ramp, color_map)


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write RGB frames as an MP4 file, one frame at a time.

    All frames have one size with even sides. The codec is H.264 if imageio-ffmpeg is installed, and
    else MPEG-4 part 2, which OpenCV can always write.


    Raises:
        OutputError: the file cannot be written, or not encoded.
    """
    first = next(frames := iter(frames))
    height, width = first.shape[:2]
    frames = itertools.chain([first], frames)
    with write_file_atomically(path, ending=path.suffix) as file:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ImportError:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(file.name, code, frames_per_second, (width, height))
            for frame in frames:
                writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            if not writer.isOpened():
                raise OutputError(f"cannot write the video {path}: OpenCV has no encoder") from None
            writer.release()
            print_note(
                f"{path.name} is MPEG-4 part 2, which browsers refuse; with "
                f"`pip install 'climategs[video]'` it becomes H.264"
            )
            return
        source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {frames_per_second} -i -"
        command = [get_ffmpeg_exe(), "-v", "error", "-y", *source.split(), *H264.split(), file.name]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
            with suppress(BrokenPipeError):  # what it refuses stands on its stderr
                for frame in frames:
                    encoder.stdin.write(frame.tobytes())
            said = encoder.communicate()[1].decode(errors="replace").strip()
        if encoder.returncode:
            raise OutputError(f"cannot write the video {path}: ffmpeg says {said}")


def write_rgb(path: Path, image: np.ndarray, *, jpeg_quality: int = 95) -> None:
    """Write a picture as PNG or JPEG, by the name's ending.

    Raises:
        OutputError: the file cannot be written.
    """
    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    write_atomic(path, data.tobytes())
