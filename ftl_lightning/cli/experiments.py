"""Verbs for experiments: ``benchmark``, ``ablate``, ``report``. Imports are local, for a fast start."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ftl_lightning.apps.ablation.plan import Stage
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.text import line, say
from ftl_lightning.services.validation import check_count

if TYPE_CHECKING:
    from ftl_lightning.apps.benchmark.run import Candidate
    from ftl_lightning.apps.benchmark.submission import Submission


@dataclass(frozen=True)
class BenchmarkOptions:
    """Run a method through the frozen suites, check a submission, make the leaderboard, or write the data.

    Attributes:
        method: registered name of the method, such as bc.
        suites: comma-separated names; empty for all that can be run here.
        skip: comma-separated names of suites to leave out.
        seeds: comma-separated seeds; a submission needs 0,1,2.
        out: submission file; a stopped run is resumed. Models and logs go to a folder beside it.
        model: folder of the pretrained models, with placeholders {suite} and {seed}; "shipped" for the models that the method's
            configurations name; empty to pretrain.
        configurations: folder with SUITE.yaml for each suite, or suites.yaml for all; empty for those of the method's package, or
            the defaults of its classes.
        root: folder of your copy of recordings, for suites whose demonstrations do not ship.
        list: print a table of the suites instead of running.
        check: submission file to check instead of running; with a method, a part of it is run again.
        recompute: share of rows that is run again.
        salt: word that, with the file, selects these rows.
        leaderboard: Markdown file to write from the submissions.
        submissions: folder of submissions.
        data: folder to write the suites' data to, with cards and hashes.
        format: format of the data: npz, safetensors, lerobot or minari.
    """

    method: str = ""
    suites: str = ""
    skip: str = ""
    seeds: str = "0,1,2"
    out: str = "submission.json"
    model: str = ""
    configurations: str = ""
    root: str = ""
    list: bool = False
    check: str = ""
    recompute: float = 0.1
    salt: str = ""
    leaderboard: str = ""
    submissions: str = "results/submissions"
    data: str = ""
    format: str = "npz"

    def __post_init__(self) -> None:
        require(0 <= self.recompute <= 1, "recompute", "a share from 0 to 1", self.recompute)
        modes = {"list": self.list, "check": self.check, "leaderboard": self.leaderboard, "data": self.data}
        given = [f"--{name}" for name, value in modes.items() if value]
        expected = "one of --list, --check, --leaderboard and --data"
        require(len(given) < 2, "benchmark", expected, f"{''.join(given[1:2])} beside another")
        different = len(set(self.seeds.split(","))) > self.seeds.count(",")
        valid = different and re.fullmatch(r"\d{1,9}(,\d{1,9})*", self.seeds)
        require(valid, "seeds", "different numbers with commas between them, such as 0,1,2", repr(short(self.seeds)))


def _numbers(options: BenchmarkOptions) -> list[int]:
    """The seeds."""
    return [int(part) for part in options.seeds.split(",")]


def _root(options: BenchmarkOptions) -> Path | None:
    return Path(options.root) if options.root else None


def _entry(options: BenchmarkOptions, work: Path) -> "Candidate":
    """The method to run, with a folder for models and logs."""
    from ftl_lightning.apps.benchmark.run import Candidate

    return Candidate(options.method, options.model, options.configurations, _root(options), work)


def benchmark(options: BenchmarkOptions) -> None:
    """Run a method, or list, check, rank or write what the ``options`` ask for instead."""
    if options.list:
        from ftl_lightning.apps.benchmark.leaderboard import suite_table

        say(suite_table())
    elif options.check:
        _check(options)
    elif options.leaderboard:
        from ftl_lightning.apps.benchmark.leaderboard import leaderboard, read_submissions
        from ftl_lightning.services.tensor_file import write_text
        from ftl_lightning.services.text import counted

        submissions = read_submissions(Path(options.submissions))
        write_text(Path(options.leaderboard), leaderboard(submissions))
        say(f"{options.leaderboard}: {counted(len(submissions), 'submission')}")
    elif options.data:
        from ftl_lightning.apps.benchmark.suite import load_suite, write_data

        for name in _chosen(options):
            written = write_data(load_suite(name), _numbers(options), Path(options.data), options.format, _root(options))
            say(f"{Path(options.data) / name}: {len(written)} files")
    else:
        expected = "the name of a method, such as ftl_igm, or --list, --check, --leaderboard or --data"
        require(options.method, "method", expected, "none")
        _run(options)


def _named(text: str, key: str) -> list[str]:
    """Names of suites. Raise UserError for an unknown or repeated name."""
    from ftl_lightning.apps.benchmark.suite import suite_names

    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        require(name in suite_names(), key, f"some of {', '.join(suite_names())}", repr(short(name)))
    require(len(set(names)) == len(names), key, "each suite once", repr(short(text)))
    return names


def _chosen(options: BenchmarkOptions) -> list[str]:
    """The named suites, or every suite that the method can run here, with notes on the others. Raise UserError if a named suite
    cannot be run.
    """
    from ftl_lightning.apps.benchmark.run import missing_of
    from ftl_lightning.apps.benchmark.suite import load_suite, suite_names

    requested, skipped = _named(options.suites, "suites"), _named(options.skip, "skip")
    chosen, root = [], _root(options)
    for name in requested or suite_names():
        if name in skipped:
            continue
        if not (missing := missing_of(load_suite(name), root, options.method)):
            chosen.append(name)
        elif requested:
            raise UserError(missing)
        else:
            say(line(f"note: left out: {missing}"), error=True)
    require(chosen, "suites", "one or more", "none that can be run here")
    return chosen


def _run(options: BenchmarkOptions) -> None:
    from ftl_lightning.apps.benchmark.run import run_benchmark
    from ftl_lightning.apps.benchmark.submission import Submission, machine
    from ftl_lightning.apps.benchmark.suite import SEEDS, load_suite
    from ftl_lightning.services.files import check_writable_file
    from ftl_lightning.services.text import counted
    from ftl_lightning.training.method import code_hash, load_method

    out = Path(options.out)
    work = out.with_name(f"{out.stem}.work")
    check_writable_file(options.out, "out")
    method = load_method(options.method)
    names = _chosen(options)
    begun = Submission(
        method=options.method,
        name=method.name,
        code=code_hash(options.method),
        machine=machine(),
        seeds=_numbers(options),
        suites={name: load_suite(name).hash for name in names},
    )
    if out.is_file():
        begun = _resumed(Submission.load(out), begun, out)
        say(f"{out}: {counted(len(begun.runs), 'run')} kept")
    else:
        advice = "some; remove the folder or give another --out"
        require(not work.exists(), str(work), "no models and logs of another run", advice)
    entry = _entry(options, work)
    for name in names:  # report mistakes early
        entry.cells(load_suite(name), _numbers(options)[0])
    begun.save(out)
    submission = run_benchmark(entry, begun, names, out)
    for name, score in submission.scores.items():
        error = f" ± {score.error:.2f}" if score.concepts > 1 else ""
        say(f"{name}: {load_suite(name).headline} {score.mean:.2f}{error}")
    hint = f"check it with: ftl-lightning benchmark {options.method} --check {options.out}"
    if tuple(_numbers(options)) != SEEDS:
        hint = f"a submission needs the seeds {','.join(map(str, SEEDS))}"
    say(f"{options.out}: {counted(len(submission.runs), 'run')}; {hint}")


def _resumed(known: "Submission", begun: "Submission", out: Path) -> "Submission":
    """Resume a submission from its file. Raise UserError for a file of another method, code, version, machine or set of suites."""
    from dataclasses import replace

    for key in ("kind", "format", "method", "name", "code", "version", "machine"):
        equal = getattr(known, key) == getattr(begun, key)
        require(equal, str(out), f"a submission of the same {key}", "another; give --out another file")
    for name in set(known.suites) & set(begun.suites):
        equal = known.suites[name] == begun.suites[name]
        require(equal, f"{out}: suite {name}", f"the hash {begun.suites[name]}", "another; give --out another file")
    seeds = [*known.seeds, *(seed for seed in begun.seeds if seed not in known.seeds)]
    return replace(known, suites={**known.suites, **begun.suites}, seeds=sorted(seeds))


def _check(options: BenchmarkOptions) -> None:
    from ftl_lightning.apps.benchmark.check import check_submission, recompute
    from ftl_lightning.services.text import counted

    path = Path(options.check)
    if options.salt or options.recompute != BenchmarkOptions.recompute:
        command = "ftl-lightning benchmark METHOD --check FILE"
        require(options.method, "recompute", f"the installed method, too: {command}", "none")
    submission, suites = check_submission(path)
    rows = sum(len(run.rows) for run in submission.runs)
    counts = f"{counted(len(suites), 'suite')}, {counted(len(submission.runs), 'run')}, {counted(rows, 'row')}"
    say(line(f"{path}: {submission.name}, {counts}: whole, and its numbers agree"))
    if not options.method:
        say("nothing was run again: that takes the installed method, too: ftl-lightning benchmark METHOD --check FILE")
        return
    if options.recompute == 0:
        return
    differences = recompute(_entry(options, Path()), submission, suites, options.recompute, options.salt)
    for difference in differences:
        say(line(f"differs: {difference}"))
    require(not differences, str(path), "the submitted numbers", f"{len(differences)} that differ; see above")


MOST_WORKERS = 1000  #: Maximum number of parallel cells.


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
    from ftl_lightning.apps.ablation.run import planned, run_ablation, show_cells, show_estimate

    stages, seeds, results = options.stages, options.seeds, options.results
    plan = planned(stages, seeds, options.root, options.only)
    if not (options.estimate or options.status or options.slurm):
        return run_ablation(part(list(plan.values()), options.shard), results, options.executor, options.address)
    if options.estimate:
        show_estimate(list(plan.values()), results, options.workers)
    if options.status:
        show_cells(results, [cell for cells in plan.values() for cell in cells])
    if options.slurm:
        from ftl_lightning.apps.ablation.run import check
        from ftl_lightning.apps.ablation.slurm import write_scripts

        check([cell for cells in plan.values() for cell in cells])
        keys = {"results": results, "seeds": list(seeds), "root": options.root}
        say("\n".join(write_scripts(options.slurm, stages, plan, keys, options.workers, options.sbatch)))


def report(
    results: str = "results",
    out: str = "results/report",
    readme: str = "",
    html: str = "",
    paper: str = "",
    run: bool = False,
    root: str = "",
) -> None:
    """Make tables and figures from results, with the paper's numbers; or an HTML page; or print a table or figure of the paper.

    Args:
        results: a results file, or a folder of results files.
        out: folder for Markdown, LaTeX and figures.
        readme: a Markdown file to update between its marks.
        html: HTML file to write instead: overview, films, concepts and curves, without a network.
        paper: table, figure or claim of the paper to print instead, such as "Table 4"; "all" for all.
        run: with ``paper``, measure its numbers again, into a subfolder of ``out``.
        root: with ``run``, the folder of recordings, for human motion.

    Raises:
        UserError: for ``paper`` without a folder of results.
    """
    if paper:
        from ftl_lightning.apps.paper import items, measure_again, printed

        chosen, folder = items("" if paper == "all" else paper), Path(results)
        if not folder.is_dir():
            raise UserError(
                f"{folder}: expected a folder of results, found nothing; run this in a checkout, or add --results FOLDER"
            )
        if run:
            measure_again(chosen, folder, folder := Path(out) / "measured again", root)
        say("\n\n".join(printed(item, folder) for item in chosen))
        return
    if html:
        from ftl_lightning.reporting.page import write_page

        say(f"{html}: {write_page(Path(results), Path(html)) / 1e6:.1f} MB")
        return
    from ftl_lightning.reporting.report import write_report

    say(write_report(Path(results), Path(out), Path(readme) if readme else None))
    say(f"written to {out}")
