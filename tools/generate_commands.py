"""The subcommand that makes datasets: a typed function, whose docstring is the help."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def generate(
    job: Positional[Path | None] = None,
    /,
    out: str = "",
    executor: Literal["serial", "processes", "ray"] = "processes",
    workers: int | None = None,
    shard: str = "1/1",
    dry_run: bool = False,
    status: bool = False,
    rescan: bool = False,
    scratch: Path | None = None,
    backend: Literal["auto", "reference", "cpu", "cuda"] = "auto",
) -> int:
    """Make a dataset: many scenes under many recipes, as a job file says (docs/generate.md).

    Run it again to go on after an interruption, on this machine or another; what is published is
    not rendered twice. Several at the same output share the work.

    Args:
        job: The job file (.yaml): scenes, recipes, variants.
        out: The output: a folder, or s3://bucket/path, gs://bucket/path.
        executor: Who renders: this process, processes of this machine, or actors of a Ray cluster.
        workers: How many; a process for every core by default, one where a GPU draws, on Ray an
            actor for every GPU then.
        shard: i/n: do only the i-th of n parts, for schedulers such as SLURM.
        dry_run: Open the scenes, say what would be rendered, and about how long it takes and how
            large it gets. Nothing is written.
        status: Say how far the jobs of the output have come; needs no job file. The exit code is 0
            if all is done.
        rescan: Open all scenes again, in case they have got frames since.
        scratch: Where images are kept until their block is uploaded, for outputs elsewhere.
        backend: Which rasteriser draws. auto: on the GPU (cuda) where there is one, else the CPU;
            on Ray the CPU.
    """
    from augment.errors import ClimateGSError

    if not out:
        raise ClimateGSError("--out is missing: a folder, or s3://bucket/path")
    if status:
        from tools.generate import show_status

        return show_status(out)
    if job is None:
        raise ClimateGSError("no job file is named: climategs generate JOB.yaml --out OUT")
    from tools.generate import generate_dataset

    return generate_dataset(
        job,
        out,
        executor=executor,
        workers=workers,
        shard=shard,
        backend=backend,
        scratch=scratch,
        rescan=rescan,
        dry_run=dry_run,
    )
