"""The `climategs` command: its table of subcommands, and how errors leave it."""

from __future__ import annotations

import logging
import os
import sys

import tyro

from tools import (
    bench_commands,
    commands,
    evaluate_command,
    export_commands,
    generate_commands,
    report_command,
    style_commands,
)

COMMANDS = {
    "render": commands.render,
    "generate": generate_commands.generate,
    "fit": commands.fit,
    "inspect": commands.inspect,
    "explain": commands.explain,
    "recipes": commands.recipes,
    "sheet": commands.sheet,
    "report": report_command.report,
    "evaluate": evaluate_command.evaluate,
    "bench": commands.bench,
    "demo": commands.demo,
    "style": commands.style,
    "export": export_commands.export,
    "mirror": export_commands.mirror,
}
# Commands of commands, which take over where the first word names one.
GROUPS = {
    "bench": {
        "raster": bench_commands.raster,
        "gpu": bench_commands.gpu,
        "smog": bench_commands.smog,
        "flood": bench_commands.flood,
        "snow": bench_commands.snow,
        "style": bench_commands.style,
        "fit": bench_commands.fit,
        "trade": bench_commands.trade,
        "jobs": bench_commands.jobs,
        "dataset": bench_commands.dataset,
        "training": bench_commands.training,
    },
    "style": {
        "apply": style_commands.apply,
        "train": style_commands.train,
        "presets": style_commands.presets,
    },
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one command. Returns 0; 1 where images failed, 2 for an error, 130 if interrupted."""
    if not sys.stderr.isatty():  # a log needs a progress line now and then, not ten a second
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    arguments = sys.argv[1:] if arguments is None else arguments
    table, prog = COMMANDS, "climategs"
    description = "Weather for driving scenes made of 3D Gaussians."
    if arguments and arguments[0] in GROUPS:
        group, *arguments = arguments
        table, prog, description = GROUPS[group], f"climategs {group}", COMMANDS[group].__doc__
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        return tyro.extras.subcommand_cli_from_dict(
            table, args=arguments, prog=prog, description=description, sort_subcommands=False
        )
    except KeyboardInterrupt as interruption:
        print(str(interruption) or "interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if not _is_ours(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2


def _is_ours(error: Exception) -> bool:
    """Errors a user can act on; others are defects, and their traceback is worth seeing."""
    from recipes.errors import RecipeError

    if isinstance(error, RecipeError):
        return True
    errors = sys.modules.get("augment.errors")  # not loaded: then none of it was raised
    return errors is not None and isinstance(error, errors.ClimateGSError)


if __name__ == "__main__":
    sys.exit(main())
