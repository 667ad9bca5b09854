"""Guards against scores of other pictures than those of a variant.

In: a rendered suite and predictions. Refused are predictions without the loader's probe, with the
probe of another variant, and predictions of two variants that are the same. A warning is given for
scores that equal the clean score to four digits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from augment.errors import ScoreError
from augment.output.codecs import decode_image
from augment.scores.predictions import META_FILE, Predictions
from augment.scores.probe import probe
from augment.scores.suite_facts import CLEAN_VARIANT, RenderedSuite

# Largest difference of a field's mean colour between two decoders of JPEG, grey levels.
MAX_FIELD_DIFFERENCE = 3
# Digits to which a score is compared with the clean one.
NUM_EQUAL_DIGITS = 4
# Length of a SHA-256 in hexadecimal digits.
SHA256_DIGITS = 64


def check_probes(suite: RenderedSuite, predictions: Mapping[str, Predictions]) -> None:
    """Refuse predictions whose network was not shown the variant that they are said to be of.

    Args:
        suite: The suite.
        predictions: Predictions by variant.

    Raises:
        ScoreError: A probe is missing, incomplete, or of other pictures.
    """
    lacking = [
        name for name, of_variant in predictions.items()
        if of_variant.meta is None or not of_variant.meta.probe
    ]  # fmt: skip
    if lacking:
        raise ScoreError(
            f"{len(lacking)} variants have no probe in {META_FILE}, so nothing shows that the "
            f"network was given their pictures: {', '.join(lacking)}. Call "
            f"augment.scores.probe.probe with your loader and the paths of `climategs suite probe` "
            f'and write {{"variant": NAME, "probe": ANSWER}}'
        )
    fields_by_path: dict[str, np.ndarray] = {}
    problems = [
        problem
        for name, of_variant in predictions.items()
        if (problem := _probe_problem(suite, name, of_variant, fields_by_path))
    ]
    if problems:
        raise ScoreError("\n".join(problems))


def _probe_problem(
    suite: RenderedSuite,
    variant: str,
    predictions: Predictions,
    fields_by_path: dict[str, np.ndarray],
) -> str:
    """Return the fault of a variant's probe as a sentence; empty if there is none.

    Args:
        fields_by_path: Mean colours of images that were decoded already, which are added to.
    """
    meta = predictions.meta
    assert meta is not None, "checked before"
    where = predictions.folder / META_FILE
    if meta.variant != variant:
        return f"{where} says that these are predictions of {meta.variant!r}, not of {variant}"
    paths = suite.entries.variants[variant].probes
    if missing := [path for path in paths if path not in meta.probe]:
        return f"{where}: the probe lacks {len(missing)} of {len(paths)} images: {missing[0]}"
    for path in paths:
        answer = meta.probe[path]
        if len(answer) == SHA256_DIGITS:
            problem = _bytes_problem(suite, path, answer)
        else:
            problem = _pixels_problem(suite, variant, path, answer, fields_by_path)
        if problem:
            return f"{where}: {problem}. The network was not shown {variant}: run it again"
    return ""


def _bytes_problem(suite: RenderedSuite, path: str, answer: str) -> str:
    """Return the fault of a SHA-256 that a loader gave of an image's bytes."""
    if answer == suite.entries.files.get(path):
        return ""
    other_paths = [other for other, digest in suite.entries.files.items() if digest == answer]
    if other_paths:
        return f"for {path} the loader gave the bytes of {other_paths[0]}"
    return f"for {path} the loader gave bytes that no file of the suite has"


def _pixels_problem(
    suite: RenderedSuite,
    variant: str,
    path: str,
    answer: str,
    fields_by_path: dict[str, np.ndarray],
) -> str:
    """Return the fault of the mean colours that a loader gave of an image."""
    try:
        fields = _parse_fields(answer)
    except ValueError:
        return f"for {path} the answer is neither a SHA-256 nor colours of fields"
    number = next(
        (k for k, row in enumerate(suite.rows[variant]) if row["image_path"] == path), None
    )
    if number is None:
        return f"{path} is no image that all variants have"
    differences: dict[str, float] = {}
    for name, rows in suite.rows.items():
        other_path = rows[number]["image_path"]
        if other_path not in fields_by_path:
            image = decode_image(suite.store.read(other_path))
            stated = probe(lambda _, image=image: image, (other_path,))[other_path]
            fields_by_path[other_path] = _parse_fields(stated)
        other_fields = fields_by_path[other_path]
        if other_fields.shape != fields.shape:
            return f"for {path} the answer has {len(fields)} fields; expected {len(other_fields)}"
        # A loader may order its channels blue, green, red.
        by_order = (np.abs(fields[:, order] - other_fields) for order in ([0, 1, 2], [2, 1, 0]))
        best = min(by_order, key=lambda difference: difference.mean())
        differences[name] = float(best.mean())
        if name == variant and best.max() > MAX_FIELD_DIFFERENCE:
            differences[name] = np.inf
    nearest = min(differences, key=lambda name: differences[name])
    if differences[variant] <= differences[nearest]:
        return ""
    if differences[nearest] > MAX_FIELD_DIFFERENCE:
        return f"for {path} the loader gave pixels of no variant of the suite"
    return f"for {path} the loader gave the pixels of {nearest}"


def _parse_fields(answer: str) -> np.ndarray:
    """Return the mean colours in an answer of `probe`, int64 [F, 3]."""
    return np.frombuffer(bytes.fromhex(answer), np.uint8).reshape(-1, 3).astype(np.int64)


def check_equal_predictions(suite: RenderedSuite, predictions: Mapping[str, Predictions]) -> None:
    """Refuse predictions that two variants share although their pictures differ.

    Variants in which nothing at all is detected may share that.

    Raises:
        ScoreError: Two variants have the same predictions.
    """
    by_hash: dict[str, list[str]] = {}
    for name, of_variant in predictions.items():
        if not of_variant.is_empty:
            by_hash.setdefault(of_variant.content_hash, []).append(name)
    groups = (
        [names[0], *(name for name in names[1:] if not suite.has_same_images(names[0], name))]
        for names in by_hash.values()
    )
    shared = [" = ".join(group) for group in groups if len(group) > 1]
    if shared:
        raise ScoreError(
            f"variants have the same predictions, though their pictures differ: "
            f"{'; '.join(shared)}. The "
            f"network was shown one of them for the others"
        )


def equal_score_warnings(
    suite: RenderedSuite, clean_score: float, scores: Mapping[str, float]
) -> list[str]:
    """Return a warning for every variant whose score equals the clean one to four digits."""
    return [
        f"{name} scores {score:.{NUM_EQUAL_DIGITS}f} as {CLEAN_VARIANT} does: was the network "
        f"shown the clean pictures?"
        for name, score in scores.items()
        if round(score, NUM_EQUAL_DIGITS) == round(clean_score, NUM_EQUAL_DIGITS)
        and not suite.has_same_images(name, CLEAN_VARIANT)
    ]


def equal_picture_warnings(suite: RenderedSuite, variants: Sequence[str]) -> list[str]:
    """Return a warning if variants have the pictures of the clean render, byte by byte."""
    unchanged = [name for name in variants if suite.has_same_images(name, CLEAN_VARIANT)]
    if not unchanged:
        return []
    return [
        f"{len(unchanged)} variants have the same pictures as {CLEAN_VARIANT}, byte by byte, so "
        f"their scores say nothing: {', '.join(unchanged)}"
    ]


def check_variants(
    names: Sequence[str], has_predictions: Callable[[str], bool], where: str
) -> None:
    """Refuse a folder that lacks the predictions of some variants.

    Raises:
        ScoreError: Variants are missing.
    """
    missing = [name for name in names if not has_predictions(name)]
    if missing:
        raise ScoreError(
            f"{where} lacks the predictions of {len(missing)} of {len(names)} variants: "
            f"{', '.join(missing)}. --effects scores some effects only"
        )
