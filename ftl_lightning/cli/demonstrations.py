"""Verbs for demonstrations: ``generate``, ``check``, ``encode``, ``prepare``. Imports are local, for a fast start."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ftl_lightning.services.errors import UserError, about, note, require
from ftl_lightning.services.text import alike, line, say
from ftl_lightning.services.validation import check_count, check_range

if TYPE_CHECKING:
    from ftl_lightning.data.check import Finding
    from ftl_lightning.data.demonstrations import Demonstrations
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.training.checks import Check


MOST_DEMONSTRATIONS, MOST_WORKERS, MOST_CONCEPTS = 1_000_000, 1000, 200
"""Maximum number of demonstrations drawn by a command, of worker processes, and of concepts of a check."""


def generate(
    domain: str,
    task: str = "",
    count: int = 100,
    seed: int = 0,
    workers: int = 1,
    out: str = "demonstrations.safetensors",
    root: str = "",
) -> None:
    """Draw demonstrations of a task into a file.

    Args:
        domain: name of a domain.
        task: in words, for example "circle right of square and triangle above square"; empty for every training concept.
        count: number of demonstrations of the task, or of each training concept.
        seed: the same seed gives the same bytes.
        workers: number of processes, in domains with a slow expert; a stopped run is resumed.
        out: file to write (.safetensors or .npz), or "minari:NAME" for a Minari data set (the extra "minari"), such as
            "minari:strokes/test-v0", or "lerobot:FOLDER" for a LeRobot data set (the extra "lerobot").
        root: folder of your copy of the data, for domains whose demonstrations do not ship.
    """
    from ftl_lightning.data.demonstrations import writer
    from ftl_lightning.domains.registry import load_domain

    check_count("count", count, 1, MOST_DEMONSTRATIONS)
    check_range("seed", seed, 0)
    check_count("workers", workers, 1, MOST_WORKERS)
    writer(out)  # refuses a format before the work
    loaded = load_domain(domain)
    source = loaded.source(Path(root) if root else None)
    try:
        demonstrations = source.draw(task, count, seed, workers) if task else source.split("train", count, seed)
    except (KeyError, ValueError, IndexError):  # a source that does not check the text itself
        if task:
            loaded.check_goal(task, "task")
        raise
    demonstrations.save(out)
    say(f"{out}: {len(demonstrations)} demonstrations of {task or f'{len(loaded.concepts.training)} training concepts'}")


def encode(domain: str, encoder: str = "minilm", revision: str = "main", out: str = "") -> None:
    """Make a domain's table of concept embeddings with a language model.

    Args:
        domain: name of a domain.
        encoder: "minilm" (the extra), or the name or path of a T5 or BERT-like model.
        revision: revision of a Hugging Face model.
        out: file to write; empty for the table that ships with the domain.

    Raises:
        UserError: without a file, for a domain without a table.
    """
    from ftl_lightning.domains.registry import load_domain
    from ftl_lightning.networks.text_encoder import load_encoder, write_table

    concepts = load_domain(domain).concepts
    require(out or concepts.table, "out", "a file to write", f"none: domain {domain} names no table")
    path = Path(out) if out else Path(str(concepts.table))
    write_table(path, load_encoder(encoder, concepts.table, revision), concepts.descriptions)
    say(path)


def prepare(domain: str, root: str = "", out: str = "") -> None:
    """Convert your copy of a domain's recordings, which do not ship, to the file of the domain.

    Args:
        domain: name of a domain.
        root: folder of your copy; nothing is downloaded.
        out: folder to write; empty for the same folder.

    Raises:
        UserError: for a domain whose demonstrations need no preparation.
    """
    from ftl_lightning.domains.registry import load_domain

    loaded = load_domain(domain)
    if loaded.recordings.prepare is None:
        raise UserError(f"domain: expected one whose recordings are prepared, found {domain!r}, which needs nothing of the kind")
    say(loaded.recordings.prepare(Path(root) if root else None, Path(out) if out else None))


@dataclass(frozen=True)
class CheckOptions:
    """Say whether demonstrations of a concept suffice, and which of them is an outlier.

    Attributes:
        file: file of demonstrations (.npz or .safetensors), folder of a LeRobot data set, or name of a Minari data set; each of its
            concepts is checked.
        pretrained: folder of the pretrained model to learn with, or the name of a shipped model; empty to check for faults alone.
        learn: also learn each concept from some of its demonstrations and measure the others; needs a model.
        figure: picture to write, .png, .svg or .pdf.
        settings: configuration file of invert with settings of learning; empty for that of the domain.
    """

    file: str
    pretrained: str = ""
    learn: bool = False
    figure: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        picture = not self.figure or Path(self.figure).suffix in (".png", ".svg", ".pdf")
        require(picture, "figure", "a name that ends in .png or .svg or .pdf", repr(self.figure))
        for name, value in (("learn", self.learn), ("settings", self.settings)):
            require(self.pretrained or not value, name, "--pretrained MODEL beside it", "no model")


def check(options: CheckOptions) -> None:
    """Check every concept of the file in ``options``; print and draw the results."""
    from ftl_lightning.data.check import axes, read_mended, with_kinds
    from ftl_lightning.few_shot.learner import FewShot

    demonstrations, broken = read_mended(options.file)
    model = FewShot.from_pretrained(options.pretrained, options.settings or None) if options.pretrained else None
    if model is not None:
        with about(options.file):
            demonstrations = model.demonstrations(demonstrations, name=Path(options.file).stem)
    else:
        with suppress(UserError):  # the check of a concept names the fault
            demonstrations, proposed = with_kinds(demonstrations)
            for text in proposed:
                note(f"{options.file}: {text}")
    for text in (*alike(demonstrations.concepts), *map(str, axes(demonstrations))):
        note(f"{options.file}: {text}")
    checks, rows_of = [], demonstrations.rows_of
    if len(rows_of) > MOST_CONCEPTS:
        note(f"{options.file}: the first {MOST_CONCEPTS} of {len(rows_of)} concepts are checked")
    for rows in list(rows_of.values())[:MOST_CONCEPTS]:
        faults = tuple(fault.within(rows) for fault in broken if set(fault.rows) <= set(rows))
        checks.append(_checked(model, demonstrations.rows(rows), faults, options.learn))
        for text_line in str(checks[-1]).splitlines():
            say(f"{text_line[: len(text_line) - len(text_line.lstrip())]}{line(text_line)}")
    if options.figure:
        from ftl_lightning.reporting.concept_figures import check_figure
        from ftl_lightning.services.tensor_file import atomic

        with atomic(options.figure) as temporary:
            check_figure(checks).savefig(temporary, dpi=110)
        say(options.figure)


def _checked(model: "FewShot | None", demonstrations: "Demonstrations", faults: "tuple[Finding, ...]", learn: bool) -> "Check":
    from ftl_lightning.data.check import check as faults_of
    from ftl_lightning.data.enough import Enough
    from ftl_lightning.data.kinds import Columns
    from ftl_lightning.training.checks import Check, check_with, faulty

    if model is None:
        findings = (*faults, *faults_of(demonstrations))
        sound = not any(finding.severity == "error" for finding in findings)
        try:
            Columns(demonstrations.state_kinds)
        except UserError:  # other concepts of the file contradict the kinds that it declares
            sound = False
        longest = int(demonstrations.lengths.max())
        enough = Enough.of(demonstrations, longest, without=faulty(findings)) if sound else None
        return Check(demonstrations.concepts[0], demonstrations, findings, enough=enough)
    steps = model.tuned.learning_steps if learn else 0
    return check_with(model.model, demonstrations, model.tuned.inversion, steps, faults, progress=True)
