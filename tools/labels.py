"""`climategs labels`: an output's labels for trainers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from augment.dataset.label_files import WHOLE, LabelOptions, NothingLabelled, write_labels
from augment.errors import ClimateGSError
from recipes.schema import Recipe
from tools.output import print_note


def label_files(
    out: Path, split: Sequence[str] = (), seed: int = 0, changes: Sequence[str] = ()
) -> list[str]:
    """Write the labels of an output in its recipes' formats.

    Without a split, seed or change, those of the last time hold.

    Returns:
        Sentences about the labels that were written, and those that were not.

    Raises:
        ClimateGSError: the split is none.
        OutputError: no recipe asks for formats.
    """
    request = None
    if split or seed or changes:
        shares = _shares(split) if split else WHOLE
        request = LabelOptions(split=shares, seed=seed, changes=tuple(changes))
    try:
        done = write_labels(out, request)
    except ValueError as error:
        raise ClimateGSError(f"--split {' '.join(split)}: {error}") from error
    counts = [f"{name} {done.objects[name]} in {done.images[name]} images" for name in done.images]
    parts = ", ".join(f"{name} {count}" for name, count in done.parts.items())
    lines = [f"labels: {done.folder} ({'; '.join(counts)}; parts: {parts})"]
    if num_hidden := max(done.num_hidden.values(), default=0):
        lines.append(f"  {num_hidden} objects are hidden by the weather (output.min_visibility)")
    if done.unmapped:
        categories_text = ", ".join(
            f"{label or 'boxes without a label'} ({count})"
            for label, count in done.unmapped.items()
        )
        lines.append(f"  of no category, and left out: {categories_text}")
    if done.without_numbers:
        lines.append(
            f"  {done.without_numbers} objects are DontCare in kitti: centre, size or rotation of "
            f"their box is not finite, or a side is not longer than 0"
        )
    if done.unused_rows:
        lines.append(
            f"  rows of output.categories that no label is of: {', '.join(done.unused_rows)}"
        )
    return lines


def write_labels_of_job(out: Path, recipes: Sequence[Recipe], images: int) -> None:
    """Write the labels for trainers at the end of a job, where a recipe asks for them."""
    if not images or not any(recipe.output.label_formats for recipe in recipes):
        return
    try:
        print("\n".join(label_files(out)))
    except NothingLabelled as error:  # the scenes have no boxes, say
        print_note(f"note: {error}")


def _shares(split: Sequence[str]) -> dict[str, float]:
    """Parse the shares of a split, such as `train=0.8`."""
    shares = {}
    for text in split:
        name, _, share = text.partition("=")
        try:
            shares[name] = float(share)
        except ValueError:
            raise ClimateGSError(f"--split {text}: write NAME=SHARE, as in train=0.8") from None
    return shares
