"""What the URI of a KITTI scene may ask for."""

from __future__ import annotations

import re
from dataclasses import dataclass

from adapters.lidar.options import DriveOptions
from augment.errors import AdapterError

ICP = "icp"
_OWN = {
    "poses": "icp, or a file with a line of 12 numbers a frame (raw drives)",
    "frame": "a frame's number (object folders)",
}


@dataclass(frozen=True)
class KittiOptions:
    """drive: the options of every drive. poses: "icp", a file's name, or None for the drive's own
    GPS/IMU. frame: which frame of an object folder; None: the only one.
    """

    drive: DriveOptions
    poses: str | None = None
    frame: int | None = None

    @staticmethod
    def from_query(query: dict[str, str], *, is_object: bool) -> KittiOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value that is none.
        """
        drive = DriveOptions.from_query("kitti", query, _OWN)
        poses, frame = query.get("poses"), query.get("frame")
        wrong = "poses" if is_object and poses is not None else None
        wrong = "frame" if not is_object and frame is not None else wrong
        if wrong:
            what = "an object folder, whose frames are unrelated" if is_object else "a raw drive"
            raise AdapterError(f"kitti: {wrong}= means nothing for {what}; it is {_OWN[wrong]}")
        if frame is not None and not re.fullmatch("[0-9]{1,9}", frame):
            raise AdapterError(f"kitti: frame must be a frame's number; got {frame!r}")
        if poses == "":
            raise AdapterError("kitti: poses must be icp or the name of a file; got nothing")
        return KittiOptions(drive, poses, None if frame is None else int(frame))
