"""The probe of a user's loader: proof that a network was shown the pictures of a variant.

`probe` needs nothing of this package. Copy it beside your loader, call it with the loader's own
function that opens an image, and write its answer into `meta.json` of the variant's predictions.
`climategs suite probe` prints the paths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any


def probe(load_image: Callable[[str], Any], paths: Iterable[str]) -> dict[str, str]:
    """Return the fingerprint of every image as a loader opens it, by path.

    Args:
        load_image: The loader's function from a path in the suite to an image: the file's bytes, or
            its pixels uint8 [H, W, 3] before they are normalised.
        paths: The variant's probe paths, as suite.json states them.

    Returns:
        The SHA-256 of bytes; of pixels the mean colours of 16 x 16 fields, as hexadecimal digits.
    """
    import hashlib

    import numpy

    answers = {}
    for path in paths:
        image = load_image(path)
        if isinstance(image, bytes):
            answers[path] = hashlib.sha256(image).hexdigest()
            continue
        strips = numpy.array_split(numpy.asarray(image), 16, axis=0)
        fields = [field for strip in strips for field in numpy.array_split(strip, 16, axis=1)]
        means = numpy.rint([field.mean(axis=(0, 1)) for field in fields])
        answers[path] = means.astype(numpy.uint8).tobytes().hex()
    return answers
