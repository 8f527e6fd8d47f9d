"""What a person did on the page with one model: demonstrations shown, concepts learned, mixes sampled."""

import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.concepts.concept import KIND, Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError, short
from ftl_lightning.few_shot import FewShot
from ftl_lightning.learned_concept import LearnedConcept, Learning
from ftl_lightning.learning.inversion_settings import PAPER
from ftl_lightning.learning.quality import GENERATED
from ftl_lightning.play import requests
from ftl_lightning.play.demonstrating import Demonstrating, as_npz
from ftl_lightning.play.films import Json, films
from ftl_lightning.play.mixing import Mixture, goal_of, judge_of, judged, samples, sampling_of, starts_of
from ftl_lightning.play.same import VARIABLES, Learned, Part, Sampled, command, python
from ftl_lightning.tensor_file import kind_of
from ftl_lightning.tuned import OWN

SHOWN, SHOWN_FIRST = 8, 4
"""Samples that are shown of a learned concept, and while it is learned."""
FIRST, EVERY, SHARE = 0.2, 0.5, 3.0
"""Seconds of learning before its first samples are shown, and the least between two showings; and how many times as long as a
showing takes is learned before the next one.
"""
TOLD = 0.05
"""Seconds between two losses that are told: each takes time from learning."""
QUICK: Mapping[str, Any] = {"form": PAPER, "samples": 16, "learning_rate": 0.3}
QUICK_STEPS = 250
"""Of learning quickly from a user's own data; chosen on strokes, see docs/experiments-own-data.md."""

Tell = Callable[[Json], None]


class Stopped(Exception):
    """Nobody waits for what is learned any more."""


@dataclass(frozen=True)
class Known:
    """A concept that can be mixed.

    Attributes:
        name: its text.
        kind: ``'training'``; ``'shipped'`` or ``'saved'``, of the model's library; ``'opened'`` from a file; ``'learned'`` here.
        composition: what samples are generated from.
        concept: what a file of it holds; ``None`` of a training concept.
        file: of one that was not learned here; else empty.
        learned: how it was learned here; else ``None``.
        demonstrations: that it was learned from here; else ``None``.
        accuracy: share of its samples that were right, where somebody judged them.
    """

    name: str
    kind: str
    composition: Composition
    concept: Concept | None = None
    file: str = ""
    learned: Learned | None = None
    demonstrations: Demonstrations | None = None
    accuracy: float | None = None

    @property
    def form(self) -> str:
        """Of the concept, in a word or two; empty for training concepts."""
        if self.concept is None:
            return ""
        return self.concept.choice.form if self.concept.choice else "modes" if self.concept.modes else "one set"


class Workspace:
    """One model, and what was done with it. Nothing is written: files are what the browser saves.

    Args:
        model: name of one that ships, or a folder.
        root: folder of the user's copy of recordings, for domains whose demonstrations do not ship.

    Raises:
        UserError: if there is no such model, or no concepts are learned through it.
    """

    def __init__(self, model: str, root: Path | None = None) -> None:
        self.name = model
        self._model = FewShot.from_pretrained(model)
        self._domain = self._model.domain
        self._shown = Demonstrating(self._model, self._domain.source(root))
        self._count = 0
        self._newest: Learned | None = None
        self._concepts = {
            f"t{number}": Known(text, "training", self._model[text]) for number, text in enumerate(self._model.training_concepts)
        }
        learned = self._model.library().learned
        for number, entry in enumerate(learned):
            found = self._model.load(str(entry.path))
            name = entry.stem if sum(other.name == entry.name for other in learned) > 1 else entry.name
            known = Known(name, entry.kind, found, found.concept, str(entry.path), accuracy=entry.accuracy)
            self._concepts[f"s{number}"] = known

    def state(self) -> dict[str, Any]:
        """All that the page shows at first."""
        domain, recorder = self._domain, self._domain.recorder
        return {
            "title": self.name.rpartition("/")[2].replace("_", " "),
            "model": {"name": self.name, "title": domain.name.replace("_", " "), "hash": self._model.model.hash},
            "recorder": recorder and {"kind": recorder.kind, "hint": recorder.hint, "tasks": list(recorder.tasks)},
            "library": self._shown.library,
            "uploads": list(self._shown.files),
            "executes": domain.closed_loop is not None and domain.closed_loop.vector_film is not None,
            "groups": list(domain.plans.groups),
            "temperature": self._model.tuned.sampling.temperature,
            "concepts": self._listed(),
            "work": self.work(),
            "viewer": None,
            "offline": None,
        }

    def work(self) -> dict[str, Any]:
        """The demonstrations that are there, and what a check says of them."""
        parts = (Part(self._newest.label, learned=self._newest),) if self._newest else ()
        return self._shown.told() | {"same": self._same(parts, None)}

    @property
    def suggestion(self) -> str:
        """A name for what is to be learned: that of the demonstrations, where a file or the library said one."""
        return self._shown.name or "new concept"

    # Demonstrations.

    def scene(self, asked: requests.Pose) -> Json:
        """A new scene to show something in."""
        return self._shown.scene(asked)

    def record(self, asked: requests.Recorded) -> Json:
        """With what a hand showed."""
        self._shown.record(asked)
        return self.work()

    def draw(self, asked: requests.Drawn) -> Json:
        """With demonstrations from the library."""
        self._shown.draw(asked)
        return self.work()

    def remove(self, asked: requests.One) -> Json:
        """Without one."""
        self._shown.remove(asked)
        return self.work()

    def undo(self, asked: requests.Nothing) -> Json:
        """As before the last change."""
        self._shown.undo()
        return self.work()

    def clear(self, asked: requests.Nothing) -> Json:
        """Without any."""
        self._shown.clear()
        return self.work()

    def upload(self, name: str, content: bytes) -> None:
        """Take a file of demonstrations, of a concept, or of another program.

        Raises:
            UserError: for one that is none of these, or of another model or domain.
        """
        if (ending := Path(name).suffix.lower()) not in self._shown.files:
            raise UserError(f"file: expected one that ends in {' or '.join(self._shown.files)}, found {short(name)!r}")
        if ending == ".safetensors" and kind_of(content) == KIND:
            self._open(Path(name).name, content)
        else:
            self._shown.read(name, content)

    def demonstrations_file(self, key: str) -> tuple[str, bytes]:
        """Name and bytes of an ``.npz`` with the demonstrations that are there, or those of a concept that was learned here.

        Raises:
            UserError: if there are none.
        """
        if not key:
            return "demonstrations.npz", as_npz(self._shown.together(""))
        known = self._known(key)
        if known.demonstrations is None or known.learned is None:
            raise UserError(f"id: expected a concept that was learned here, found {short(known.name)!r}")
        return known.learned.demonstrations, as_npz(known.demonstrations)

    # Concepts.

    def _known(self, key: str) -> Known:
        if (found := self._concepts.get(key)) is None:
            raise UserError(f"id: expected a concept that is there, found {short(key)!r}")
        return found

    def _listed(self) -> list[Json]:
        return [self._told(key, known) for key, known in self._concepts.items()]

    def _told(self, key: str, known: Known) -> Json:
        count = None if known.concept is None else known.concept.origin.count
        told = {"id": key, "name": known.name, "kind": known.kind, "count": count, "form": known.form}
        return told | {"accuracy": known.accuracy, "hash": self._model.model.hash}

    def _open(self, name: str, content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "concept.safetensors"
            path.write_bytes(content)
            try:
                found = self._model.load(path)
            except UserError as error:
                told = str(error).replace(str(path), short(name))
                raise UserError(f"{told}; open the model that it was learned with first") from error
        self._count += 1
        self._concepts[f"o{self._count}"] = Known(found.concept.origin.name, "opened", found, found.concept, name)

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

    def forget(self, asked: requests.Named) -> None:
        """Go on without a concept that was learned or opened here.

        Raises:
            UserError: for one of the model's own.
        """
        if self._known(asked.id).kind not in ("learned", "opened"):
            raise UserError("id: expected a concept that was learned or opened here, found one of the model's")
        del self._concepts[asked.id]

    def rename(self, asked: requests.Renamed) -> None:
        """Call a concept otherwise that was learned or opened here; its file then says so.

        Raises:
            UserError: for one of the model's own.
        """
        known, name = self._known(asked.id), " ".join(asked.name.split())
        if known.kind not in ("learned", "opened") or known.concept is None:
            raise UserError("id: expected a concept that was learned or opened here, found one of the model's")
        if name == known.name:
            return
        concept = replace(known.concept, origin=replace(known.concept.origin, name=name))
        learned = known.learned and replace(known.learned, label=self._unused(name))
        self._newest = learned if self._newest is known.learned else self._newest
        self._concepts[asked.id] = replace(known, name=name, concept=concept, learned=learned)

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
        own, begin = self._shown.together(name), monotonic()
        changes, steps = self._settings(asked.quick)
        due, told_at = begin + FIRST, begin

        def watch(now: Learning) -> None:
            nonlocal due, told_at
            if stopped():
                raise Stopped
            if (shown := monotonic()) >= told_at + TOLD or now.step in (1, steps):
                tell({"step": now.step, "steps": steps, "loss": round(now.loss, 5)})
                told_at = shown
            if shown >= due:
                tell({"step": now.step, "samples": self._samples(now.so_far(), SHOWN_FIRST, own)[0]})
                due = monotonic() + max(EVERY, SHARE * (monotonic() - shown))

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what they tell stands beside the demonstrations
            concept = self._model.learn(own, name=name, steps=steps, watch=watch, **changes)
        seconds = monotonic() - begin
        self._count += 1
        told_steps = None if steps == self._model.tuned.learning_steps else steps
        key, how = f"l{self._count}", Learned(name, self._unused(name), changes, told_steps)
        known = Known(name, "learned", concept, concept.concept, learned=how, demonstrations=own)
        shown, right = self._samples(concept, GENERATED, own)
        quality: Json = {"line": right, "numbers": {}}
        if len(own) > 1:
            found = concept.quality.quality
            quality = {"line": ", ".join(filter(None, (right, found.words))), "numbers": found.numbers}
        decided = [film["right"] for film in shown if film["right"] is not None]
        self._concepts[key] = known = replace(known, accuracy=sum(decided) / len(decided) if decided else None)
        self._newest = how
        told = {"done": True, "concept": self._told(key, known), "concepts": self._listed(), "quality": quality}
        same = self._same((Part(how.label, learned=how),), None)
        tell({**told, "samples": shown[:SHOWN], "seconds": round(seconds, 2), "same": same})

    def _unused(self, name: str) -> str:
        """A label whose files and variable no other concept that was learned here has."""
        taken = VARIABLES | {known.learned.variable for known in self._concepts.values() if known.learned}
        found, number = name, 2
        while Learned(name, found).variable in taken:
            found, number = f"{name} {number}", number + 1
        return found

    def _settings(self, quick: bool) -> tuple[dict[str, Any], int]:
        """What differs from the tuned settings, and steps: where a person waits, a single set of embeddings, learned quickly."""
        tuned, steps = self._model.tuned.inversion, self._model.tuned.learning_steps
        if not quick or tuned.modes.sets != 1 or tuned.adapter.rank:
            return {}, steps
        if self._model.settings == OWN:
            return dict(QUICK), QUICK_STEPS
        return {"form": PAPER}, steps

    # Samples.

    def sample(self, asked: requests.Sample) -> Json:
        """Samples of a mix.

        Raises:
            UserError: for a concept or group that is none, or what cannot be executed.
        """
        begin = monotonic()
        known = [self._known(part.id) for part in asked.parts]
        width, plans = self._model.model.config.state_dim, self._domain.plans
        concepts = [
            (part.weight * one.composition).on(plans.grouped(part.groups), width) if part.groups else part.weight * one.composition
            for part, one in zip(asked.parts, known, strict=True)
        ]
        names = [one.name for one in known]
        examples = [
            replace(one.demonstrations, concepts=(one.name,) * len(one.demonstrations)) for one in known if one.demonstrations
        ]
        mixture = Mixture(concepts, names, examples)
        shown, told, how = samples(self._model, mixture, asked, (self._shown.task, *names))
        parts = [
            Part(one.name, part.weight, tuple(part.groups), one.learned, one.file)
            for part, one in zip(asked.parts, known, strict=True)
        ]
        return {"samples": shown, "told": told, "seconds": round(monotonic() - begin, 3), "same": self._same(parts, how)}

    def _samples(self, concept: LearnedConcept, count: int, own: Demonstrations) -> tuple[list[Json], str]:
        """Of a concept that was just learned from some demonstrations, and what share is right."""
        task, starts = starts_of(self._model, (self._shown.task,), count, 0)
        plans = self._model.sample(concept, count, starts, seed=0, **sampling_of(self._model))
        judge = judge_of(self._model, [own])
        return judged(judge, plans, goal_of(judge, (concept.concept.origin.name,), task))

    def thumbnail(self, key: str) -> Json:
        """A sample of a concept."""
        known = self._known(key)
        _, starts = starts_of(self._model, (known.name, self._shown.task), 1, 0)
        plans = self._model.sample(known.composition, 1, starts, seed=0, **sampling_of(self._model))
        return {"film": films(self._domain, plans)[0]}

    def _same(self, parts: Sequence[Part], how: Sampled | None) -> Json:
        return {"python": python(self.name, parts, how), "command": command(self.name, self._model.settings, parts, how)}
