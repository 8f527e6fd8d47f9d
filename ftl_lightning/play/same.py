"""What was done on the page, as Python and as commands that give the same numbers."""

import keyword
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ftl_lightning.concepts.concept import file_name
from ftl_lightning.learning.inversion_settings import INVERSION

FOLDER = "concepts"
"""Where commands write learned concepts."""
VARIABLES = frozenset({"model", "mixed", "starts", "samples", "episodes", *keyword.kwlist})
"""Names that a concept's variable may not have."""


@dataclass(frozen=True)
class Learned:
    """A concept that was learned on the page.

    Attributes:
        name: under which it was learned, which decides where learning starts.
        label: its name on the page, which may have been changed.
        changes: settings that differ from those that go with the model.
        steps: of gradient descent; ``None`` for the tuned number.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    steps: int | None = None

    @property
    def variable(self) -> str:
        """A name that Python takes."""
        word = re.sub(r"\W+", "_", self.label.lower()).strip("_") or "concept"
        return f"_{word}" if word[0].isdigit() else word

    @property
    def file(self) -> str:
        """Of the concept, that the page downloads."""
        return f"{self.variable}.safetensors"

    @property
    def demonstrations(self) -> str:
        """File of them that the page downloads."""
        return f"{self.variable}.npz"


@dataclass(frozen=True)
class Part:
    """A part of what is mixed.

    Attributes:
        text: of a training concept, or the name of a learned one.
        weight: that multiplies its own.
        groups: of columns that it is on; all where empty.
        learned: how it was learned; ``None`` for a training concept.
        file: of a concept that was neither learned here nor in pretraining; empty for others.
    """

    text: str
    weight: float = 1.0
    groups: Sequence[str] = ()
    learned: Learned | None = None
    file: str = ""


@dataclass(frozen=True)
class Sampled:
    """How samples were made.

    Attributes:
        count, seed, temperature, sampler, steps: as of ``FewShot.sample``.
        task: whose initial states they start from; empty in domains without any.
        execute: whether they were executed in closed loop.
    """

    count: int
    seed: int
    temperature: float
    sampler: str
    steps: int
    task: str = ""
    execute: bool = False


def python(model: str, parts: Sequence[Part], how: Sampled | None) -> str:
    """A script.

    Args:
        model: name or folder.
        parts: that were mixed, or what was learned.
        how: samples were made; ``None`` for none.
    """
    learned = list({part.learned.variable: part.learned for part in parts if part.learned}.values())
    lines = ["from ftl_lightning import FewShot"]
    lines += ["from ftl_lightning.demonstrations import Demonstrations"] if learned else []
    lines += ["", f"model = FewShot.from_pretrained({model!r})"]
    for one in learned:
        told = "".join(f", {key}={value!r}" for key, value in _settings(one).items())
        lines.append(f"{one.variable} = model.learn(Demonstrations.load({one.demonstrations!r}), name={one.name!r}{told})")
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
    """As ``--compose`` takes it."""
    told = []
    for part in parts:
        name = f"{FOLDER}/{file_name(part.learned.name)}.safetensors" if part.learned else part.file or part.text
        at = f"@{','.join(part.groups)}" if part.groups else ""
        told.append(f"{name}{at}:{part.weight:g}")
    return " + ".join(told)


def command(model: str, configuration: str, parts: Sequence[Part], how: Sampled | None) -> str:
    """Commands.

    Args:
        model: name or folder.
        configuration: file of ``invert`` that goes with it.
        parts, how: as of :func:`python`.
    """
    lines = []
    for one in {part.learned.variable: part.learned for part in parts if part.learned}.values():
        words = ["python", "-m", "ftl_lightning", "invert", "--config", configuration, "--model.pretrained", model]
        words += ["--data.demonstrations", one.demonstrations, "--model.output", FOLDER]
        for key, value in one.changes.items():
            words += [f"--model.{INVERSION.get(key, key)}", str(value)]
        words += [] if one.steps is None else ["--data.steps", str(one.steps)]
        lines.append(shlex.join(words))
    if how is not None and parts:
        words = ["python", "-m", "ftl_lightning", "sample", "--pretrained", model, "--compose", composed(parts)]
        words += ["--count", str(how.count), "--seed", str(how.seed), "--sampler", how.sampler, "--steps", str(how.steps)]
        words += ["--temperature", f"{how.temperature:g}", *(["--goal", how.task] if how.task else [])]
        words += ["--execute", "true"] if how.execute else []
        lines.append(shlex.join(words))
    return "\n".join(lines) + "\n"
