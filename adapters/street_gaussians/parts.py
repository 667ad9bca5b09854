"""One trained part, the background or an actor: from the numbers in a file to Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from augment.errors import AdapterError, SceneError
from augment.gaussian_checks import drawable_rows, is_drawable
from augment.scene import SH_COUNTS, Gaussians, check_gaussians

_ROWS = 1 << 15  # Gaussians changed at a time: temporaries of a few megabytes


@dataclass(frozen=True, eq=False)
class Part:
    """terms [N, F - 1, 3]: further Fourier terms of the colours; None where F is 1."""

    gaussians: Gaussians
    terms: Tensor | None

    @property
    def term_count(self) -> int:
        """F."""
        return 1 if self.terms is None else 1 + self.terms.shape[1]


def allocate(count: int, sh_count: int, term_count: int) -> tuple[dict[str, Tensor], Tensor | None]:
    """Memory of a part's numbers, to be filled as they stand in a file: log scales, opacity logits,
    quaternions of any length. Named as in Gaussians; the second are the terms.
    """
    arrays = {
        "means": torch.empty(count, 3),
        "quats": torch.empty(count, 4),
        "scales": torch.empty(count, 3),
        "opacities": torch.empty(count),
        "sh": torch.empty(count, sh_count, 3),
    }
    return arrays, torch.empty(count, term_count - 1, 3) if term_count > 1 else None


def check_counts(where: str, rest: int, terms: int, *, is_background: bool) -> None:
    """rest: SH coefficients above the constant one. terms: F.

    Raises:
        AdapterError: no such spherical harmonics, or a background whose colours change.
    """
    if rest + 1 not in SH_COUNTS:
        known = ", ".join(str(count - 1) for count in SH_COUNTS)
        raise AdapterError(
            f"{where}: feature_rest must have {known} coefficients a channel (SH degrees 0 to 3); "
            f"got {rest}"
        )
    if terms < 1 or (is_background and terms > 1):
        expected = "1 colour term" if is_background else "1 colour term or more"
        raise AdapterError(f"{where}: feature_dc must have {expected}; got {terms}")


def finish_part(
    arrays: Mapping[str, Tensor], terms: Tensor | None, where: str
) -> tuple[Part, tuple[str, ...]]:
    """Activate the numbers where they lie and leave out what cannot be drawn, with a sentence each.

    Raises:
        AdapterError: nothing usable remains.
    """
    _activate(arrays)
    if terms is not None:
        _mark_bad_terms(arrays["means"], terms)
    gaussians = Gaussians(**arrays)
    if len(gaussians) and is_drawable(gaussians):
        return Part(gaussians, terms), ()
    try:
        kept, problems = check_gaussians(gaussians, where=where)
    except SceneError as error:
        raise AdapterError(str(error)) from None
    return Part(kept, None if terms is None else terms[drawable_rows(gaussians)]), problems


def _activate(arrays: Mapping[str, Tensor]) -> None:
    arrays["scales"].exp_()
    arrays["opacities"].sigmoid_()
    quats = arrays["quats"].numpy()
    for start in range(0, len(quats), _ROWS):
        piece = quats[start : start + _ROWS]
        # In float64, where lengths of any float32 neither overflow nor vanish.
        lengths = np.sqrt(np.einsum("ni,ni->n", piece, piece, dtype=np.float64))
        lengths[lengths == 0] = 1  # such a quaternion is left out later
        piece /= lengths[:, None]


def _mark_bad_terms(means: Tensor, terms: Tensor) -> None:
    """A splat whose colours are not numbers at some time is none that can be drawn."""
    for start in range(0, len(terms), _ROWS):
        piece = slice(start, start + _ROWS)
        bad = ~np.isfinite(terms[piece].numpy()).all((1, 2))
        if bad.any():
            means[piece][torch.from_numpy(bad)] = torch.nan
