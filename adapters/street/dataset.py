"""The record of the embedded procedural street."""

from adapters.dataset import Dataset

PROCEDURAL = Dataset(
    scheme="procedural",
    description="nothing yet",
    page="procedural-street.md",
    example="procedural:street?seed=3",
    opener="adapters.procedural:open_procedural",
    builtin=("street",),
    labels="adapters.procedural:procedural_labels",
)
