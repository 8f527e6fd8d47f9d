"""The verb ``ablate`` and its options. Imports are deferred for a fast start."""

from dataclasses import dataclass, field
from typing import Literal

from ftl_lightning.apps.ablation import Stage
from ftl_lightning.services.printing import say
from ftl_lightning.services.ranges import check_count

MOST_WORKERS = 1000
"""Maximum number of parallel cells."""


@dataclass(frozen=True)
class AblateOptions:
    """Run every cell of an ablation that is not in the results.

    Attributes:
        stages: verbs with grids of options, in order.
        results: results file to which rows are added.
        seeds: each stage runs once per seed.
        shard: "3/8" for the third of eight parts; models that it does not make itself must exist.
        executor: "ray" (the extra "cluster") runs cells in parallel on a Ray cluster, or on this machine's processors.
        root: folder of recordings, for domains that read one: data.root of every cell.
        address: address of the Ray cluster's head, HOST:PORT; empty for RAY_ADDRESS, or else a cluster on this machine.
        only: numbers of the stages to run, from 1; empty for all.
        estimate: run nothing; print the number of cells to run and the estimated hours.
        status: run nothing; print the table of cells with their states, also while another process runs them.
        slurm: run nothing; write a script for Slurm's sbatch to this file, or several in order, whose jobs run shards.
        workers: parallel cells, for the estimate; jobs of each Slurm array (0: a job per cell).
        sbatch: more options of sbatch by name, such as {partition: long, time: "02:00:00"}.
    """

    stages: list[Stage]
    results: str
    seeds: list[int] = field(default_factory=lambda: [0])
    shard: str = "1/1"
    executor: Literal["local", "ray"] = "local"
    root: str = ""
    address: str = ""
    only: list[int] = field(default_factory=list)
    estimate: bool = False
    status: bool = False
    slurm: str = ""
    workers: int = 0
    sbatch: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_count("workers", self.workers, 0, MOST_WORKERS)


def ablate(options: AblateOptions) -> None:
    """Run the cells, or print or write what the options ask for instead."""
    from ftl_lightning.apps.ablation.plan import part
    from ftl_lightning.apps.ablation.run import check, planned, run_ablation, show_cells, show_estimate

    stages, seeds, results = options.stages, options.seeds, options.results
    plan = planned(stages, seeds, options.root, options.only)
    if not (options.estimate or options.status or options.slurm):
        return run_ablation(part(list(plan.values()), options.shard), results, options.executor, options.address)
    if options.estimate:
        show_estimate(list(plan.values()), results, options.workers)
    if options.status:
        show_cells(results, [cell for cells in plan.values() for cell in cells])
    if options.slurm:
        from ftl_lightning.apps.ablation.slurm import write_scripts

        check([cell for cells in plan.values() for cell in cells])
        keys = {"results": results, "seeds": list(seeds), "root": options.root}
        say("\n".join(write_scripts(options.slurm, stages, plan, keys, options.workers, options.sbatch)))
