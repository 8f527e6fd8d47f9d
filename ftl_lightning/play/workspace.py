"""What a person did on the page with one model: demonstrations shown, concepts learned, samples of their mixes."""

import io
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.demonstrations.npz import npz_bytes
from ftl_lightning.domains.recorder import Scene
from ftl_lightning.errors import UserError, short
from ftl_lightning.evaluation.animation import outcome_text
from ftl_lightning.few_shot import FewShot
from ftl_lightning.learned_concept import LearnedConcept, Learning
from ftl_lightning.learning.inversion_settings import PAPER
from ftl_lightning.play import requests
from ftl_lightning.play.films import Json, episode_films, film, films
from ftl_lightning.play.same import Learned, Part, Sampled, command, python

WANTED = 5
"""Demonstrations that a person is asked for."""
MOST, MOST_SCENES, MOST_UNDONE = 50, 50, 50
"""Demonstrations of a concept, scenes that are remembered, and steps that can be undone."""
SHOWN = 8
"""Samples that are shown of a learned concept."""
FIRST, EVERY = 0.3, 0.6
"""Seconds of learning after which its first samples are shown, and the least between two showings."""
STEPS = 10
"""Of the sampler, at most: a slider that moves wants an answer at once."""
TOLERANCE = 0.03
"""Of learning quickly, where the settings stop at no other."""

Tell = Callable[[Json], None]


class Stopped(Exception):
    """Nobody waits for what is being learned any more."""


@dataclass(frozen=True)
class Known:
    """A concept that can be mixed.

    Attributes:
        name: its text.
        kind: ``'training'``, ``'shipped'``, ``'saved'``, ``'opened'`` from a file, or ``'learned'`` here.
        composition: what samples are generated from.
        concept: what a file of it holds; ``None`` of a training concept.
        file: of one that was not learned here.
        learned: how it was; ``None`` for one that was not learned here.
        demonstrations: that it was learned from here.
    """

    name: str
    kind: str
    composition: Composition
    concept: Concept | None = None
    file: str = ""
    learned: Learned | None = None
    demonstrations: Demonstrations | None = None
    accuracy: float | None = None


class Workspace:
    """One model, and what was done with it. Nothing is written but what the browser saves.

    Args:
        model: name of one that ships, or a folder.
        root: folder of the user's copy of recordings, for domains whose demonstrations do not ship.
    """

    def __init__(self, model: str, root: Path | None = None) -> None:
        self.name = model
        self._few = FewShot.from_pretrained(model)
        self._domain = self._few.domain
        self._source = self._domain.source(root)
        self._work: list[tuple[int, Demonstrations]] = []
        self._undone: list[list[tuple[int, Demonstrations]]] = []
        self._scenes: dict[int, Scene] = {}
        self._count = 0
        self._task = ""
        self._last: tuple[Sequence[Part], Sampled | None] = ((), None)
        self._concepts = {
            f"t{number}": Known(text, "training", self._few[text]) for number, text in enumerate(self._few.training_concepts)
        }
        for number, entry in enumerate(self._few.library()):
            if entry.path is not None:
                concept = self._few.load(entry.path)
                known = Known(entry.name, entry.kind, concept, concept.concept, str(entry.path), accuracy=entry.accuracy)
                self._concepts[f"s{number}"] = known

    # --- what there is

    def state(self) -> dict[str, Any]:
        """All that the page shows at first."""
        recorder = self._domain.recorder
        return {
            "title": self.name.rpartition("/")[2].replace("_", " "),
            "model": {"name": self.name, "title": self._domain.name.replace("_", " "), "hash": self._few.model.hash},
            "recorder": recorder and {"kind": recorder.kind, "hint": recorder.hint, "tasks": list(recorder.tasks)},
            "library": self._library(),
            "uploads": [".npz", ".safetensors", *self._domain.imports],
            "executes": self._domain.closed_loop is not None and self._domain.closed_loop.vector_film is not None,
            "groups": list(self._domain.plans.groups),
            "temperature": self._few.tuned.sampling.temperature,
            "concepts": self._listed(),
            "work": self.work(),
            "viewer": None,
            "offline": None,
        }

    def _library(self) -> Json:
        concepts = self._domain.concepts
        known = dict.fromkeys((*concepts.training, *(goal for suite in concepts.suites.values() for goal in suite.goals)))
        try:
            self._source.draw(next(iter(known)), 1, 0)
        except UserError as error:
            return {"tasks": [], "why": str(error)}
        return {"tasks": list(known), "why": ""}

    def _listed(self) -> list[Json]:
        return [self._told(key, known) for key, known in self._concepts.items()]

    def _told(self, key: str, known: Known) -> Json:
        concept = known.concept
        form = "" if concept is None else concept.choice.form if concept.choice else "modes" if concept.modes else "one set"
        return {
            "id": key,
            "name": known.name,
            "kind": known.kind,
            "count": None if concept is None else concept.origin.count,
            "form": form,
            "accuracy": known.accuracy,
            "hash": self._few.model.hash,
        }

    def work(self) -> dict[str, Any]:
        """The demonstrations that are there, and what a check says of them."""
        flags: dict[int, list[str]] = {}
        told: list[str] = []
        if self._work:
            findings = self._few.check(self._together("demonstrations")).findings
            told = [str(one) for one in findings if not one.rows]
            for finding in findings:
                for row in finding.rows:
                    flags.setdefault(row, []).append(finding.text)
        shown = [
            {"id": number, "film": films(self._domain, own)[0], "flags": flags.get(row, [])}
            for row, (number, own) in enumerate(self._work)
        ]
        return {"demonstrations": shown, "check": told, "undo": bool(self._undone), "same": self._same(), "wanted": WANTED}

    def _together(self, name: str) -> Demonstrations:
        """All demonstrations as those of one concept."""
        if not self._work:
            raise UserError("demonstrations: expected one or more, found none; show the model something first")
        joined = concatenate([own for _, own in self._work])
        return replace(joined, concepts=(name,) * len(joined))

    # --- demonstrations

    def scene(self, asked: requests.Pose) -> Json:
        """A new scene to show something in.

        Raises:
            UserError: in a domain where nothing can be shown by hand.
        """
        if (recorder := self._domain.recorder) is None:
            raise UserError(f"scene: expected a model whose behaviour can be shown by hand, found {self.name}")
        if asked.task and asked.task not in recorder.tasks:
            raise UserError(f"task: expected one of {len(recorder.tasks)} of {self.name}, found {short(asked.task)!r}")
        self._count += 1
        scene = recorder.scene(asked.task, self._count)
        self._task = asked.task or self._task
        self._scenes[self._count] = scene
        self._scenes = dict(list(self._scenes.items())[-MOST_SCENES:])
        pieces = [{"name": one.name, "at": list(one.at), "shapes": list(one.shapes)} for one in scene.pieces]
        told = {"film": film(scene.film), "pieces": pieces, "speed": scene.speed, "seconds": scene.seconds}
        return {"scene": self._count, **told}

    def record(self, asked: requests.Recorded) -> Json:
        """A demonstration that a hand gave.

        Raises:
            UserError: for a scene that is none, or a path that is.
        """
        if (recorder := self._domain.recorder) is None or (scene := self._scenes.get(asked.scene)) is None:
            raise UserError(f"scene: expected a scene that was asked for, found {asked.scene}; reload the page")
        try:
            path = np.array(asked.path, dtype=np.float64)
        except ValueError as error:
            raise UserError("path: expected as many places at each step, found others") from error
        self._add([recorder.record(scene, path, np.array(asked.seconds, dtype=np.float64))])
        return self.work()

    def draw(self, asked: requests.Drawn) -> Json:
        """Demonstrations from the library: the expert's, or recordings.

        Raises:
            UserError: for a task that it does not know.
        """
        self._domain.expect_goal(asked.task, "task")
        self._count += 1
        drawn = self._source.draw(asked.task, asked.count, self._count)
        self._task = asked.task
        self._add([drawn.rows([row]) for row in range(len(drawn))])
        return self.work()

    def _add(self, new: Sequence[Demonstrations]) -> None:
        if len(self._work) + len(new) > MOST:
            raise UserError(f"demonstrations: expected at most {MOST} of a concept, found {len(self._work) + len(new)}")
        self._keep()
        for own in new:
            self._count += 1
            self._work.append((self._count, own))

    def _keep(self) -> None:
        """For undoing."""
        self._undone = [*self._undone, list(self._work)][-MOST_UNDONE:]

    def remove(self, asked: requests.One) -> Json:
        """Without one demonstration.

        Raises:
            UserError: if it is not there.
        """
        if all(number != asked.id for number, _ in self._work):
            raise UserError(f"id: expected a demonstration that is there, found {asked.id}")
        self._keep()
        self._work = [(number, own) for number, own in self._work if number != asked.id]
        return self.work()

    def undo(self, asked: requests.Nothing) -> Json:
        """As before the last change of the demonstrations."""
        if self._undone:
            self._work = self._undone.pop()
        return self.work()

    def clear(self, asked: requests.Nothing) -> Json:
        """Without any demonstrations."""
        if self._work:
            self._keep()
        self._work = []
        return self.work()

    def upload(self, name: str, content: bytes) -> Json:
        """A file of demonstrations, of a concept, or of another program.

        Raises:
            UserError: for one that is none of these, or of another model or domain.
        """
        ending = Path(name).suffix.lower()
        if ending not in (".npz", ".safetensors", *self._domain.imports):
            expected = " or ".join((".npz", ".safetensors", *self._domain.imports))
            raise UserError(f"file: expected one that ends in {expected}, found {short(name)!r}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"file{ending}"
            path.write_bytes(content)
            try:
                self._read(path, name)
            except UserError as error:  # which names a file that the user does not know
                raise UserError(str(error).replace(str(path), short(Path(name).name))) from error
        return self.state()

    def _read(self, path: Path, name: str) -> None:
        stem = Path(name).stem
        if path.suffix in self._domain.imports:
            found = self._domain.imports[path.suffix](path)
        elif path.suffix == ".safetensors" and _holds_concept(path):
            learned = self._few.load(path)
            self._count += 1
            self._concepts[f"o{self._count}"] = Known(learned.concept.origin.name, "opened", learned, learned.concept, name)
            return
        else:
            found = self._few.demonstrations(Demonstrations.load(path), name=stem)
        self._add([found.rows([row]) for row in range(len(found))])

    def demonstrations_file(self, key: str) -> tuple[str, bytes]:
        """Name and bytes of an ``.npz`` with the demonstrations that are there, or of a concept that was learned here.

        Raises:
            UserError: if there are none.
        """
        if not key:
            return "demonstrations.npz", npz_bytes(self._together(""))
        known = self._known(key)
        if known.demonstrations is None or known.learned is None:
            raise UserError(f"id: expected a concept that was learned here, found {short(known.name)!r}")
        return known.learned.demonstrations, npz_bytes(known.demonstrations)

    # --- concepts

    def _known(self, key: str) -> Known:
        if (found := self._concepts.get(key)) is None:
            raise UserError(f"id: expected a concept that is there, found {short(key)!r}")
        return found

    def concept_file(self, key: str) -> tuple[str, bytes]:
        """Name and bytes of a concept's file.

        Raises:
            UserError: for a training concept, which the model itself holds.
        """
        known = self._known(key)
        if known.concept is None:
            raise UserError(f"id: expected a learned concept, found the training concept {short(known.name)!r}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "concept.safetensors"
            known.concept.save(path)
            return known.learned.file if known.learned else Path(known.file).name, path.read_bytes()

    def forget(self, asked: requests.Named) -> Json:
        """Without a concept that was learned or opened here.

        Raises:
            UserError: for one of the model's own.
        """
        if self._known(asked.id).kind not in ("learned", "opened"):
            raise UserError("id: expected a concept that was learned or opened here, found one of the model's")
        del self._concepts[asked.id]
        return self.state()

    def learn(self, asked: requests.Learn, tell: Tell, stopped: Callable[[], bool]) -> None:
        """Learn a concept from the demonstrations, telling loss and samples as it goes.

        Args:
            asked: name and how.
            tell: called with each line that the page is told.
            stopped: whether nobody waits any more.

        Raises:
            UserError: without demonstrations, or where they cannot be learned from.
            Stopped: if nobody waits.
        """
        name = " ".join(asked.name.split())
        own, begin = self._together(name), monotonic()
        changes, shown = self._settings(asked.quick), begin + FIRST - EVERY
        steps = self._few.tuned.learning_steps

        def watch(now: Learning) -> None:
            nonlocal shown
            if stopped():
                raise Stopped
            tell({"step": now.step, "steps": steps, "loss": round(now.loss, 5)})
            if monotonic() - shown >= EVERY:
                tell({"step": now.step, "samples": self._samples(now.so_far(), SHOWN, 0)})
                shown = monotonic()

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what they tell stands beside the demonstrations
            concept = self._few.learn(own, name=name, watch=watch, **changes)
        self._count += 1
        key = f"l{self._count}"
        how = Learned(self._unused(name), changes)
        known = Known(name, "learned", concept, concept.concept, learned=how, demonstrations=own)
        quality: Json = {"line": "", "numbers": {}}
        if len(own) > 1:
            found = concept.quality
            quality = {"line": str(found), "numbers": found.quality.numbers}
            known = replace(known, accuracy=None if found.right is None else found.right[1])
        self._concepts[key] = known
        self._last = ((Part(name, learned=how),), None)
        samples, seconds = self._samples(concept, SHOWN, 0), monotonic() - begin
        told = {"done": True, "concept": self._told(key, known), "concepts": self._listed(), "quality": quality}
        tell({**told, "samples": samples, "seconds": round(seconds, 2), "same": self._same()})

    def _unused(self, name: str) -> str:
        """A name whose files and variable no other concept that was learned here has."""
        taken = {known.learned.variable for known in self._concepts.values() if known.learned}
        found, number = name, 2
        while Learned(found).variable in taken:
            found, number = f"{name} {number}", number + 1
        return found

    def _settings(self, quick: bool) -> dict[str, Any]:
        """What differs from the tuned settings."""
        tuned = self._few.tuned.inversion
        if not quick or tuned.modes.sets != 1 or tuned.adapter.rank:
            return {}
        budget = tuned.budget
        found: dict[str, Any] = {"form": PAPER}
        found |= {} if budget.tolerance is not None else {"tolerance": TOLERANCE}
        return found

    # --- samples

    def sample(self, asked: requests.Sample) -> Json:
        """Samples of a mix.

        Raises:
            UserError: for a concept or group that is none, or what cannot be executed.
        """
        begin = monotonic()
        known = [self._known(part.id) for part in asked.parts]
        mixed = self._mix(asked, known)
        temperature = self._few.tuned.sampling.temperature if asked.temperature is None else asked.temperature
        task, starts = self._starts(asked.task, known, asked.count, asked.seed)
        goal = self._goal(asked, known, task)
        how = self._sampling() | {"temperature": temperature}
        if asked.execute:
            if starts is None:
                raise UserError(f"execute: expected a model whose behaviour is carried out, found {self.name}")
            done = self._few.execute(mixed, starts, goal, seed=asked.seed, **how)
            outcomes = self._domain.judge(goal, done.rollout) if goal else {}
            shown = episode_films(self._domain, done.rollout, outcomes)
            told = ", ".join(f"{name} {value:.2f}" for name, value in done.outcomes.items())
        else:
            plans = self._few.sample(mixed, asked.count, starts, seed=asked.seed, **how)
            shown, told = self._judged(plans, goal)
        told = f"{told} ({goal})" if told else ""
        sampled = Sampled(asked.count, asked.seed, temperature, how["sampler"], how["steps"], task, asked.execute)
        parts = [
            Part(one.name, part.weight, tuple(part.groups), one.learned, one.file)
            for part, one in zip(asked.parts, known, strict=True)
        ]
        self._last = (parts, sampled)
        return {"samples": shown, "told": told, "seconds": round(monotonic() - begin, 3), "same": self._same()}

    def _mix(self, asked: requests.Sample, known: Sequence[Known]) -> Composition:
        plans, width = self._domain.plans, self._few.model.config.state_dim
        parts = []
        for part, one in zip(asked.parts, known, strict=True):
            weighted = part.weight * one.composition
            parts.append(weighted.on(plans.grouped(part.groups), width) if part.groups else weighted)
        mixed, *rest = parts
        for other in rest:
            mixed = mixed + other
        return mixed

    def _sampling(self) -> dict[str, Any]:
        tuned = self._few.tuned.sampling
        return {"sampler": "dpm_solver", "steps": min(tuned.steps, STEPS) if tuned.sampler == "dpm_solver" else STEPS}

    def _samples(self, concept: LearnedConcept, count: int, seed: int) -> list[Json]:
        """Of a concept that is or was just learned, from new initial states."""
        name = concept.concept.origin.name
        task, starts = self._starts("", [Known(name, "learned", concept)], count, seed)
        plans = self._few.sample(concept, count, starts, seed=seed, **self._sampling())
        return self._judged(plans, task if self._domain.observed else name)[0]

    def _starts(self, task: str, known: Sequence[Known], count: int, seed: int) -> tuple[str, InitialStates | None]:
        """The task whose initial states samples start from, and these; nothing in domains without any."""
        if not self._domain.observed:
            return "", None
        asked = (task, self._task, *(one.name for one in known), *self._few.training_concepts)
        for text in filter(self._domain.concepts.reads, asked):
            return text, self._few.starts(text, count, seed)
        raise UserError(f"task: expected one that {self.name} knows, found {short(task)!r}")

    def _goal(self, asked: requests.Sample, known: Sequence[Known], task: str) -> str:
        """What samples are judged by: the mix in words where the domain reads it, or the one concept; empty where nobody can say."""
        if task:
            named = [one.name for one in known]
            return task if task == asked.task or named == [task] else named[0] if self._domain.concepts.reads(named[0]) else ""
        text = " and ".join(one.name for one in known)
        return text if self._domain.concepts.reads(text) else ""

    def _judged(self, plans: Demonstrations, goal: str) -> tuple[list[Json], str]:
        """Films of samples, and the share that is right, if anybody can say."""
        judging = self._few.judging
        right = None
        if goal and judging.metrics and judging.concepts.reads(goal):
            measured = judging.measure(goal, plans.states, plans.initial_states)
            right = next(((key, own) for key, own in measured.items() if own.dtype == torch.bool and own.dim()), None)
        if right is None:
            return films(self._domain, plans), ""
        return films(self._domain, plans, right[1].tolist()), f"{right[0]} {float(right[1].float().mean()):.2f}"

    def thumbnail(self, key: str) -> Json:
        """A sample of a concept."""
        known = self._known(key)
        _, starts = self._starts("" if known.kind == "learned" else known.name, [known], 1, 0)
        plans = self._few.sample(known.composition, 1, starts, seed=0, **self._sampling())
        return {"film": films(self._domain, plans)[0]}

    def _same(self) -> Json:
        parts, how = self._last
        settings = self._few.settings
        return {"python": python(self.name, parts, how), "command": command(self.name, settings, parts, how)}


def _holds_concept(path: Path) -> bool:
    """Whether a safetensors file is one of a concept."""
    try:
        Concept.load(path)
    except UserError as error:
        if "concept file" not in str(error):  # it is a damaged one
            raise
        return False
    return True
