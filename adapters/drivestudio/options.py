"""What a drivestudio URI may ask for, as in `drivestudio:<run>?data=DIR&frames=0:50`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from augment.errors import AdapterError

_KEYS = {
    "data": "the processed scene's folder, such as data/waymo/processed/training/023",
    "checkpoint": "the name of a checkpoint in the run, such as checkpoint_15000.pth",
    "frames": "first:stop, numbers of the data's frames, either of them left out at will",
}
_FRAMES = re.compile(r"(\d*):(\d*)", re.ASCII)


@dataclass(frozen=True)
class RunOptions:
    """Options of one opening; None where the run decides. stop_frame is excluded."""

    data: str | None = None
    checkpoint: str | None = None
    first_frame: int = 0
    stop_frame: int | None = None

    @staticmethod
    def from_query(query: dict[str, str]) -> RunOptions:
        """The options of a URI's query.

        Raises:
            AdapterError: an unknown key, or a value that cannot be used.
        """
        unknown = sorted(set(query) - set(_KEYS))
        if unknown:
            known = "; ".join(f"{key}: {kind}" for key, kind in _KEYS.items())
            raise AdapterError(f"drivestudio: unknown option {unknown[0]!r}; known are {known}")
        for key in ("data", "checkpoint"):
            if query.get(key) == "":
                raise AdapterError(f"drivestudio: {key} must be {_KEYS[key]}; got ''")
        first, stop = 0, None
        if "frames" in query:
            match = _FRAMES.fullmatch(query["frames"])
            first, stop = (int(t) if t else None for t in match.groups()) if match else (0, 0)
            first = first or 0
            if stop is not None and stop <= first:
                raise AdapterError(
                    f"drivestudio: frames must be {_KEYS['frames']}; got {query['frames']!r}"
                )
        return RunOptions(query.get("data"), query.get("checkpoint"), first, stop)

    def select(self, numbers: range, where: str) -> tuple[int, ...]:
        """Those of the run's frames that the scene has.

        Raises:
            AdapterError: none is left.
        """
        stop = numbers.stop if self.stop_frame is None else self.stop_frame
        kept = tuple(number for number in numbers if self.first_frame <= number < stop)
        if not kept:
            raise AdapterError(
                f"{where}: frames={self.first_frame}:{stop} selects none of the run's frames "
                f"{numbers[0]} to {numbers[-1]}"
            )
        return kept
