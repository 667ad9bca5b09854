"""`climategs evaluate`."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from tools.json_files import JsonFile, write_json


def evaluate(
    out: Positional[str],
    short: int = 1,
    long: int = 7,
    scenes: str = "all",
    recipes: str = "all",
    pairs: int | None = None,
    lpips: Path | None = None,
    lpips_heads: Path | None = None,
    pictures: Path | None = None,
    json_file: JsonFile = None,
) -> int:
    """Measure how consistent an output's images are: between frames, and between cameras.

    One image is warped into the other by the depth that was written with them, and compared where
    both show the same (docs/evaluation.md). Finished images are taken while jobs are running, too.

    Args:
        out: A folder that `climategs render` or `generate` wrote, or its URI (s3://bucket/path).
        short: How many frames are apart over short range.
        long: How many frames are apart over long range.
        scenes: Scene names separated by commas, or all.
        recipes: Recipe names separated by commas, or all.
        pairs: At most so many pairs of each kind from each variant of a scene, evenly chosen.
        lpips: Weights for LPIPS, .pth or .safetensors: of lpips.LPIPS (alex or vgg), or of
            torchvision's alexnet or vgg16 with lpips-heads. Nothing is downloaded.
        lpips_heads: The file of LPIPS's linear heads, where lpips has none.
        pictures: A folder for a picture of each recipe's worst pair of each kind.
        json_file: Also write all figures to this file, those of every pair included.
    """
    from tools.evaluate import evaluate_output
    from tools.evaluate_text import evaluation_text

    facts = evaluate_output(
        out,
        short=short,
        long=long,
        scenes=None if scenes == "all" else scenes.split(","),
        recipes=None if recipes == "all" else recipes.split(","),
        pairs=pairs,
        lpips=lpips,
        lpips_heads=lpips_heads,
        pictures=pictures,
    )
    print(evaluation_text(facts))
    write_json(json_file, facts)
    return 0
