"""The subcommands of `climategs style`: typed functions, whose docstrings are the help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from tools.json_files import JsonFile, write_json

_Files = Annotated[tuple[Path, ...], arg(metavar="PATH [PATH ...]")]
_Scenes = Annotated[tuple[str, ...], arg(name="scene", metavar="URI [URI ...]")]


def apply(
    scene: Positional[str],
    style: Positional[str],
    out: Path,
    method: Literal["mkl", "reinhard", "gscm"] = "mkl",
    strength: float = 1.0,
    per_region: bool = False,
    mask: Path | None = None,
    checkpoint: Path | None = None,
    overwrite: bool = False,
    json_file: JsonFile = None,
) -> int:
    """Write a scene in the colours of a photograph or a preset, with a picture of both beside it.

    Args:
        scene: The scene, as for render.
        style: An image file, or the name of a style preset; `climategs style presets` lists them.
        out: The styled scene's folder; open it as scene:OUT.
        method: mkl maps mean and covariance of the colours, reinhard mean and spread of each
            channel, gscm is the network.
        strength: 0 leaves the colours, 1 takes on the style's, up to 2 goes beyond.
        per_region: Maps of their own for road, vegetation and the rest.
        mask: An image, white where the style image shows sky.
        checkpoint: A trained network for gscm, in place of the one that comes with the package.
        overwrite: Replace the scene that is there.
        json_file: Also write the maps and figures to this file.
    """
    from tools.style_apply import apply_style

    facts = apply_style(
        scene,
        style,
        out,
        method=method,
        strength=strength,
        per_region=per_region,
        mask=mask,
        checkpoint=checkpoint,
        overwrite=overwrite,
    )
    write_json(json_file, facts)
    return 0


def train(
    out: Path,
    photos: _Files = (),
    scenes: _Scenes = (),
    minutes: float | None = None,
    steps: int | None = None,
    encoder: Literal["small", "b0"] = "small",
    matrix: Literal["3x4", "3x3"] = "3x4",
    encoder_weights: Path | None = None,
    vgg: Path | None = None,
    size_px: int | None = None,
    views: int = 24,
    seed: int = 0,
    learning_rate: float | None = None,
    decay: float = 0.1,
    warm_up: float = 0.1,
    style: float = 1.0,
    consistency: float = 10.0,
    cycle: float = 10.0,
    pairs: float = 1.0,
    pair_weights: str = "",
    batch: int = 2,
    pair_batch: int = 4,
    scene_share: float = 0.5,
    holdout: int = 8,
    half_precision: bool = False,
    through: Literal["picture", "renderer"] = "picture",
    device: str = "cpu",
    ablations: bool = False,
    overwrite: bool = False,
    json_file: JsonFile = None,
) -> int:
    """Train the network that turns a style image into a colour map, on photos and scenes.

    Run it again to go on after an interruption; the result is the same to the bit. Ctrl-C stops
    after the current step and keeps what is there.

    Args:
        out: The folder for the network, its checkpoint, curves and report.
        photos: Image files, and folders of them.
        scenes: Scenes whose views are learnt from, as for render.
        minutes: How long to train, 10 by default.
        steps: How many steps instead. The same steps and seed give the same bytes.
        encoder: The small one for a CPU, or EfficientNet-B0.
        matrix: 3x4 maps with an offset, or 3x3 as in the paper.
        encoder_weights: EfficientNet-B0's weights, trained on ImageNet.
        vgg: Weights of VGG-19 for the style loss; without them a bank of filters stands in.
        size_px: Of the square pictures; the encoder's usual one by default.
        views: Most views of a scene.
        seed: Of everything random.
        learning_rate: Adam's; the encoder's usual one by default.
        decay: What the learning rate is multiplied by after each third of the steps.
        warm_up: Share of the steps that learn the cycle alone.
        style: Weight of the style loss.
        consistency: Weight of the loss in content space.
        cycle: Weight of the cycle's loss.
        pairs: Weight of recoloured pairs of photos, whose perfect result is known.
        pair_weights: Of the losses of pairs, as same=1,look=2; the others keep theirs.
        batch: Transfers a step.
        pair_batch: Pairs a step.
        scene_share: Share of the transfers whose content is a view of a scene.
        holdout: Every so many photos are kept for scores; 0 for none.
        half_precision: Write the network's numbers in 16 bits.
        through: Render mapped Gaussians for every step, or map pictures rendered once.
        device: Where torch trains: cpu, or cuda, where through renderer renders on the GPU, too.
        ablations: Train without each loss, and 3x3 maps, too, and write a table.
        overwrite: Begin anew and replace what is there.
        json_file: Also write the report to this file.
    """
    from tools.style_train import train_style
    from tools.style_train_options import StyleTrainOptions

    options = StyleTrainOptions(
        out=out,
        scenes=scenes,
        photos=photos,
        minutes=minutes,
        steps=steps,
        encoder=encoder,
        matrix=matrix,
        encoder_weights=encoder_weights,
        vgg=vgg,
        size_px=size_px,
        views=views,
        seed=seed,
        learning_rate=learning_rate,
        decay=decay,
        warm_up=warm_up,
        style=style,
        consistency=consistency,
        cycle=cycle,
        pairs=pairs,
        pair_weights=pair_weights,
        batch=batch,
        pair_batch=pair_batch,
        scene_share=scene_share,
        holdout=holdout,
        half_precision=half_precision,
        through=through,
        device=device,
        ablations=ablations,
        overwrite=overwrite,
    )
    outcome = train_style(options)
    write_json(json_file, outcome.report)
    return outcome.code


def presets(name: Positional[str | None] = None) -> int:
    """List the style presets, or print one of them.

    Args:
        name: A preset to print.
    """
    from recipes.weather import style_preset_names, style_preset_text

    print("\n".join(style_preset_names()) if name is None else style_preset_text(name), end="")
    if name is None:
        print()
    return 0
