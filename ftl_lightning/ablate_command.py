"""The verb ``ablate``: its options, and what it does. Its imports are inside, so that it starts at once."""

from dataclasses import dataclass, field
from typing import Literal

from ftl_lightning.ablation import Stage
from ftl_lightning.printing import say
from ftl_lightning.ranges import expect_count

MOST_WORKERS = 1000
"""Cells side by side."""


@dataclass(frozen=True)
class AblateOptions:
    """Run every cell of an ablation that the results do not hold yet.

    Attributes:
        stages: verbs with grids of options, in order.
        results: results file that rows are added to.
        seeds: each stage runs once a seed.
        shard: "3/8" for the third of eight parts; models that it needs and does not make itself must be there.
        executor: "ray" (the extra "cluster") runs cells side by side on a Ray cluster, or on this machine's processors.
        root: folder of recordings, of domains that read one: data.root of every cell.
        address: of the Ray cluster's head, HOST:PORT; empty for RAY_ADDRESS, or else a cluster that runs on this machine.
        only: numbers of the stages to run, from 1; empty for all.
        estimate: run nothing; print how many cells are to be run, and for how many hours by those that were measured.
        status: run nothing; print the table of what became of each cell, also while another process runs them.
        slurm: run nothing; write a script for Slurm's sbatch to this file, or several in order, whose jobs run shards.
        workers: cells side by side, for the estimate; jobs of each of Slurm's arrays (0: one for each cell).
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
        expect_count("workers", self.workers, 0, MOST_WORKERS)


def ablate(options: AblateOptions) -> None:
    """Run the cells, or tell or write what the options ask for in place of running them."""
    from ftl_lightning.ablation.run import planned, run_ablation, show_cells, show_estimate

    stages, seeds, results = options.stages, options.seeds, options.results
    if not (options.estimate or options.status or options.slurm):
        return run_ablation(stages, seeds, results, options.shard, options.executor, options.root, options.address, options.only)
    plan = planned(stages, seeds, options.root, options.only)
    if options.estimate:
        show_estimate(list(plan.values()), results, options.workers)
    if options.status:
        show_cells(results, [cell for cells in plan.values() for cell in cells])
    if options.slurm:
        from ftl_lightning.ablation.check import check
        from ftl_lightning.ablation.slurm import write_scripts

        check([cell for cells in plan.values() for cell in cells])
        keys = {"results": results, "seeds": list(seeds), "root": options.root}
        say("\n".join(write_scripts(options.slurm, stages, plan, keys, options.workers, options.sbatch)))
