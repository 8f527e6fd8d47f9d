"""Python code and commands that reproduce the page's results exactly."""

import keyword
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ftl_lightning.igm.concept import file_name
from ftl_lightning.igm.settings import INVERSION

FOLDER = "concepts"  # folder to which commands write learned concepts
VARIABLES = frozenset({"model", "mixed", "starts", "samples", "episodes", *keyword.kwlist})
"""Names that are not allowed as a concept's variable."""


@dataclass(frozen=True)
class Learned:
    """A concept learned on the page: name during learning, a key of the initial embedding; current name; settings that differ from
    the model's; and gradient steps, ``None`` for the tuned number.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    steps: int | None = None

    @property
    def variable(self) -> str:
        """Valid Python name."""
        word = re.sub(r"\W+", "_", self.label.lower()).strip("_") or "concept"
        return f"_{word}" if word[0].isdigit() else word

    @property
    def file(self) -> str:
        """File name of the concept when downloaded from the page."""
        return f"{self.variable}.safetensors"

    @property
    def demonstrations(self) -> str:
        """File name of the demonstrations when downloaded from the page."""
        return f"{self.variable}.npz"


@dataclass(frozen=True)
class Part:
    """Term of a mixture: text or name of a concept, factor of its weight, and groups of columns (empty for all); ``learned`` for a
    concept of this page, ``file`` for other learned concepts.
    """

    text: str
    weight: float = 1.0
    groups: Sequence[str] = ()
    learned: Learned | None = None
    file: str = ""


@dataclass(frozen=True)
class Sampled:
    """Settings of ``FewShot.sample``, task of the initial states (empty for none), and whether samples were executed in closed
    loop.
    """

    count: int
    seed: int
    temperature: float
    sampler: str
    steps: int
    task: str = ""
    execute: bool = False


def python(model: str, parts: Sequence[Part], how: Sampled | None) -> str:
    """Python script that learns the concepts of ``parts`` and, unless ``how`` is ``None``, samples their mixture."""
    learned = list({part.learned.variable: part.learned for part in parts if part.learned}.values())
    lines = ["from ftl_lightning import FewShot"]
    lines += ["from ftl_lightning.data import Demonstrations"] if learned else []
    lines += ["", f"model = FewShot.from_pretrained({model!r})"]
    for entry in learned:
        args = "".join(f", {key}={value!r}" for key, value in _settings(entry).items())
        lines.append(f"{entry.variable} = model.learn(Demonstrations.load({entry.demonstrations!r}), name={entry.name!r}{args})")
    if how is not None and parts:
        grouped = any(part.groups for part in parts)
        mixed = f"model.compose({composed(parts)!r})" if grouped and not learned else " + ".join(map(_term, parts))
        lines += ["", f"mixed = {mixed}"]
        options = f"seed={how.seed}, sampler={how.sampler!r}, steps={how.steps}, temperature={how.temperature!r}"
        if how.task:
            lines.append(f"starts = model.starts({how.task!r}, count={how.count}, seed={how.seed})")
        if how.execute:
            lines.append(f"episodes = model.execute(mixed, starts, {options})")
        else:
            start = ", observed=starts" if how.task else ""
            lines.append(f"samples = model.sample(mixed, count={how.count}{start}, {options})")
    return "\n".join(lines) + "\n"


def _settings(learned: Learned) -> dict[str, Any]:
    return dict(learned.changes) | ({} if learned.steps is None else {"steps": learned.steps})


def _term(part: Part) -> str:
    if part.learned:
        concept = part.learned.variable
    elif part.file:
        concept = f"model.load({part.file!r})"
    else:
        concept = f"model[{part.text!r}]"
    if part.groups:
        concept = f"{concept}.on(model.domain.plans.grouped({tuple(part.groups)!r}), model.model.config.state_dim)"
    return f"{part.weight:g} * {concept}"


def composed(parts: Sequence[Part]) -> str:
    """Value of ``--compose``."""
    terms = []
    for part in parts:
        name = f"{FOLDER}/{file_name(part.learned.name)}.safetensors" if part.learned else part.file or part.text
        at = f"@{','.join(part.groups)}" if part.groups else ""
        terms.append(f"{name}{at}:{part.weight:g}")
    return " + ".join(terms)


def command(model: str, configuration: str, parts: Sequence[Part], how: Sampled | None) -> str:
    """Shell commands equivalent to :func:`python`; ``configuration`` is the file of ``invert`` for the model."""
    lines = []
    for entry in {part.learned.variable: part.learned for part in parts if part.learned}.values():
        words = ["python", "-m", "ftl_lightning", "invert", "--config", configuration, "--model.pretrained", model]
        words += ["--data.demonstrations", entry.demonstrations, "--model.output", FOLDER]
        for key, value in entry.changes.items():
            words += [f"--model.{INVERSION.get(key, key)}", str(value)]
        words += [] if entry.steps is None else ["--data.steps", str(entry.steps)]
        lines.append(shlex.join(words))
    if how is not None and parts:
        words = ["python", "-m", "ftl_lightning", "sample", "--pretrained", model, "--compose", composed(parts)]
        words += ["--count", str(how.count), "--seed", str(how.seed), "--sampler", how.sampler, "--steps", str(how.steps)]
        words += ["--temperature", f"{how.temperature:g}", *(["--goal", how.task] if how.task else [])]
        words += ["--execute", "true"] if how.execute else []
        lines.append(shlex.join(words))
    return "\n".join(lines) + "\n"
