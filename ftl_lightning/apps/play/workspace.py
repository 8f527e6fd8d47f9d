"""Session with a model on the page: demonstrations, learned concepts and samples of mixtures."""

import functools
import operator
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.demonstrating import Demonstrating, as_npz
from ftl_lightning.apps.play.mixing import Json, films, goal_of, judge_of, judged, samples, sampling_of, starts_of, verdicts
from ftl_lightning.apps.play.same import VARIABLES, Learned, Part, Sampled, command, python
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.enough import Outliers
from ftl_lightning.few_shot.learned_concept import LearnedConcept, Learning
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.few_shot.tuned import OWN
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import KIND, Concept
from ftl_lightning.igm.forms.quality import GENERATED
from ftl_lightning.igm.settings import ONE, PAPER
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.tensor_file import kind_of
from ftl_lightning.training.checks import several_concepts

SHOWN, SHOWN_FIRST = 8, 4  # number of samples shown of a learned concept, and during learning
FIRST, INTERVAL, RATIO = 0.2, 0.5, 3.0
"""Seconds of learning before the first samples, minimum seconds between samples, minimum ratio of learning to sampling time."""
REPORT = 0.05  # minimum seconds between reported losses: each report takes time from learning
QUICK: Mapping[str, Any] = {"form": PAPER, "samples": 16, "learning_rate": 0.3}
QUICK_STEPS = 250  # steps of quick learning from a user's data; chosen on strokes, see docs/findings.md#own-data

Tell = Callable[[Json], None]
R = TypeVar("R")


def title_of(model: str) -> str:
    """Title of a model on the page."""
    path = Path(model)
    name = path.parent.parent.name if path.name == "pretrained" and path.parent.name == "fit" else path.name
    return name.replace("_", " ")


class Stopped(Exception):
    """Learning was aborted because no client waits for the result."""


@dataclass(frozen=True)
class Known:
    """Concept that can be mixed.

    Attributes:
        name, kind: text, and ``'training'``; ``'shipped'`` or ``'saved'`` in the model's library; ``'opened'`` from a file;
            ``'learned'`` here.
        concept, file: content, and path or name of the concept's file; empty for training concepts.
        learned, demonstrations: how the concept was learned here, and from what; else ``None``.
        task: task of the demonstrations, if the library gave them; its initial states are sampled from.
        accuracy: fraction of correct samples; ``None`` if not judged.
        former: concept that this one replaced; ``None`` for none.
        source, seconds: numbers of the demonstrations it was learned from here, and how long that took.
    """

    name: str
    kind: str
    composition: Composition
    concept: Concept | None = None
    file: str = ""
    learned: Learned | None = None
    demonstrations: Demonstrations | None = None
    task: str = ""
    accuracy: float | None = None
    former: "Known | None" = None
    source: tuple[int, ...] = ()
    seconds: float = 0.0

    @property
    def content(self) -> Json:
        """Content for the page's list of concepts; the form is empty for training concepts."""
        content: Json = {"name": self.name, "kind": self.kind, "count": None, "form": "", "accuracy": self.accuracy}
        content |= {"former": self.former is not None, "from": list(self.source), "seconds": self.seconds}
        if (concept := self.concept) is not None:
            content["count"] = concept.origin.count
            content["form"] = concept.choice.form if concept.choice else "modes" if concept.modes else "one set"
        return content


def _renamed(known: Known, name: str, label: str) -> Known:
    """A concept that was learned or opened here, and its former versions, under another name."""
    concept = known.concept and replace(known.concept, origin=replace(known.concept.origin, name=name))
    learned = known.learned and replace(known.learned, label=label)
    former = known.former and _renamed(known.former, name, label)
    return replace(known, name=name, concept=concept, learned=learned, former=former)


def _fewer(share: float | None, before: float | None) -> bool:
    """Whether a share of :data:`GENERATED` samples is lower than before by two standard errors; ``False`` if not judged."""
    if share is None or before is None:
        return False
    return before - share > 2 * ((share * (1 - share) + before * (1 - before)) / GENERATED) ** 0.5


def _changing(change: Callable[[Demonstrating, R], None]) -> Callable[["Workspace", R], Json]:
    """Method that changes the demonstrations and returns the new work."""

    def method(workspace: "Workspace", request: R) -> Json:
        change(workspace._demonstrating, request)
        return workspace.work()

    return method


class Workspace:
    """Model, by name or folder, and the state of its session. No files are written: the browser saves them. ``root`` is the user's
    copy of recordings, for domains whose demonstrations do not ship.
    """

    def __init__(self, model: str, root: Path | None = None) -> None:
        self.name = model
        self._model = FewShot.from_pretrained(model)
        self._hash = self._model.model.hash  # of all weights: too slow to compute for each concept
        self._domain = self._model.domain
        self._count = 0
        self._newest: Learned | None = None
        self._concepts = {
            f"t{number}": Known(text, "training", self._model[text]) for number, text in enumerate(self._model.training_concepts)
        }
        learned = self._model.library().learned
        for number, entry in enumerate(learned):
            concept = self._model.load(str(entry.path))
            name = entry.stem if sum(item.name == entry.name for item in learned) > 1 else entry.name
            known = Known(name, entry.kind, concept, concept.concept, str(entry.path), accuracy=entry.accuracy)
            self._concepts[f"s{number}"] = known
        shipped = {known.concept.origin.name: known.composition for known in self._concepts.values() if known.concept}
        trained = {known.name: known.composition for known in self._concepts.values() if not known.concept}
        replacing = shipped | trained if root is None else {}  # a folder that cannot be read is reported
        self._demonstrating = Demonstrating(self._model, self._domain.source(root), replacing)

    @functools.cached_property
    def _outliers(self) -> Outliers | None:
        """Judge of demonstrations that belong to another concept; ``None`` for a shipped domain."""
        model = self._model.model
        return None if model.examples is None else Outliers(model.examples, model.horizon, model.places)

    def state(self) -> dict[str, Any]:
        """Initial state of the page."""
        domain, recorder = self._domain, self._domain.recordings.recorder
        return {
            "title": title_of(self.name),
            "model": {"name": self.name, "title": domain.name.replace("_", " "), "hash": self._hash},
            "recorder": recorder and {"kind": recorder.kind, "hint": recorder.hint, "tasks": list(recorder.tasks)},
            "library": self._demonstrating.library,
            "uploads": list(self._demonstrating.files),
            "executes": domain.closed_loop is not None and domain.closed_loop.vector_film is not None,
            "groups": list(domain.plans.groups),
            "temperature": self._model.tuned.sampling.temperature,
            "verdicts": verdicts(self._model.model),
            "concepts": self._listed(),
            "work": self.work(),
            "viewer": None,
            "offline": None,
        }

    def work(self) -> dict[str, Any]:
        """Current demonstrations and findings of their check."""
        parts = (Part(self._newest.label, learned=self._newest),) if self._newest else ()
        return self._demonstrating.report() | {"same": self._same(parts, None), "concepts": self._listed()}

    @property
    def suggestion(self) -> str:
        """Suggested name of the concept: the name of the demonstrations, if a file or the library gave it."""
        return self._demonstrating.name or "new concept"

    def scene(self, request: requests.Pose) -> Json:
        """Draw a new scene for a demonstration."""
        return self._demonstrating.scene(request)

    record, draw = _changing(Demonstrating.record), _changing(Demonstrating.draw)
    remove, undo, clear = _changing(Demonstrating.remove), _changing(Demonstrating.undo), _changing(Demonstrating.clear)

    def upload(self, name: str, content: bytes) -> None:
        """Read demonstrations, a concept, or another program's file. Raise UserError for others, or another model or domain."""
        ending, endings = Path(name).suffix.lower(), self._demonstrating.files
        require(ending in endings, "file", f"a name that ends in {' or '.join(endings)}", repr(short(name)))
        if ending == ".safetensors" and kind_of(content) == KIND:
            self._open(Path(name).name, content)
        else:
            self._demonstrating.read(name, content)

    def demonstrations_file(self, key: str) -> tuple[str, bytes]:
        """Name and bytes of an ``.npz`` of the current demonstrations, or of a concept's. Raise UserError if there are none."""
        if not key:
            return "demonstrations.npz", as_npz(self._demonstrating.together(""))
        _, learned, demonstrations = self._learned_here(key)
        return learned.demonstrations, as_npz(demonstrations)

    # Concepts.

    def _known(self, key: str) -> Known:
        require(key in self._concepts, "id", "an existing concept", repr(short(key)))
        return self._concepts[key]

    def _editable(self, key: str) -> Known:
        """Concept that was learned or opened here."""
        known = self._known(key)
        require(known.kind in ("learned", "opened"), "id", "a concept that was learned or opened here", "one of the model's")
        return known

    def _learned_here(self, key: str) -> tuple[Known, Learned, Demonstrations]:
        """Concept that was learned here, how, and from what."""
        known = self._known(key)
        if known.demonstrations is None or known.learned is None:
            raise UserError(f"id: expected a concept that was learned here, found {short(known.name)!r}")
        return known, known.learned, known.demonstrations

    def _content(self, key: str) -> Json:
        return {"id": key, **self._concepts[key].content, "hash": self._hash}

    def _listed(self) -> list[Json]:
        return [self._content(key) for key in self._concepts]

    def _open(self, name: str, content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "concept.safetensors"
            path.write_bytes(content)
            try:
                concept = self._model.load(path)
            except UserError as error:
                message = str(error).replace(str(path), short(name))
                raise UserError(f"{message}; open the model that it was learned with first") from error
        self._count += 1
        self._concepts[f"o{self._count}"] = Known(concept.concept.origin.name, "opened", concept, concept.concept, name)

    def concept_file(self, key: str) -> tuple[str, bytes]:
        """Name and bytes of a concept's file; training concepts have none and are refused."""
        known = self._known(key)
        if known.concept is None:
            raise UserError(f"id: expected a learned concept, found the training concept {short(known.name)!r}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "concept.safetensors"
            known.concept.save(path)
            return known.learned.file if known.learned else Path(known.file).name, path.read_bytes()

    def forget(self, request: requests.Named) -> None:
        """Remove a concept that was learned or opened here; concepts of the model are refused."""
        self._editable(request.id)
        del self._concepts[request.id]

    def rename(self, request: requests.Renamed) -> None:
        """Rename a concept that was learned or opened here, also in its file; concepts of the model are refused."""
        known, name = self._editable(request.id), " ".join(request.name.split())
        if name == known.name or known.concept is None:
            return
        label = self._unused(name)
        self._concepts[request.id] = renamed = _renamed(known, name, label)
        self._newest = renamed.learned if self._newest is known.learned else self._newest

    def learn(self, request: requests.Learn, tell: Tell, stopped: Callable[[], bool]) -> None:
        """Learn a concept quickly, and report loss and samples meanwhile by ``tell``; or learn it again, see
        :class:`~ftl_lightning.apps.play.requests.Learn`.

        Args:
            stopped: called after each step; whether no client waits.

        Raises:
            UserError: if there are no demonstrations, they cannot be learned from, or the replaced concept was not learned here.
            Stopped: if no client waits, or the concept that is learned again has been removed.
        """
        if request.again:
            return self._learn_again(request.again, tell, stopped)
        name = " ".join(request.name.split())
        demonstrations, task, begin = self._demonstrating.together(name), self._demonstrating.task, monotonic()
        source = self._demonstrating.numbers
        same = (key for key, known in self._concepts.items() if known.kind == "learned" and known.name == name)
        key = request.replaces or next(same, "")  # another tab may have learned it
        former, how, _ = self._learned_here(key) if key else (None, None, None)
        changes, steps = self._settings(True)
        due, reported = begin + FIRST, begin

        def watch(now: Learning) -> None:
            nonlocal due, reported
            if (clock := monotonic()) >= reported + REPORT or now.step in (1, steps):
                tell({"step": now.step, "steps": steps, "loss": round(now.loss, 5)})
                reported = clock
            if clock >= due:
                tell({"step": now.step, "samples": self._samples(now.so_far(), SHOWN_FIRST, demonstrations, task)[0]})
                due = monotonic() + max(INTERVAL, RATIO * (monotonic() - clock))

        concept = self._invert(demonstrations, changes, steps, stopped, watch)
        self._count += 1
        label = how.label if how is not None and how.name == name else self._unused(name)
        learned = self._newest = Learned(name, label, changes, self._changed(steps))
        content = Known(name, "learned", concept, concept.concept, "", learned, demonstrations, task, former=former, source=source)
        known, found = self._measured(content, concept)
        if stopped():
            raise Stopped
        kept = self._keep(key or f"l{self._count}", replace(known, seconds=round(monotonic() - begin, 2)))
        tell(kept | found | {"more": self._settings(False) != (changes, steps)})

    def restore(self, request: requests.Named) -> Json:
        """Undo that a concept was learned again from other demonstrations: return the former one, its samples and their quality."""
        former = self._known(request.id).former
        if former is None or former.learned is None or not isinstance(former.composition, LearnedConcept):
            raise UserError(f"id: expected a concept with a former version, found {short(request.id)!r}; learn it again first")
        self._newest = former.learned
        known, found = self._measured(former, former.composition)
        return self._keep(request.id, known) | found

    def _learn_again(self, key: str, tell: Tell, stopped: Callable[[], bool]) -> None:
        """Learn a concept in the form that its demonstrations select, and tell whether they belong to one concept. It replaces the
        former concept: for a user's data always, as it has the best score on left-out demonstrations; in other domains unless it
        was learned in the same way or has fewer right samples by two standard errors.
        """
        (_, _, demonstrations), begin = self._learned_here(key), monotonic()
        changes, steps = self._settings(False)
        concept = self._invert(demonstrations, changes, steps, lambda: stopped() or key not in self._concepts)
        before, former, learned_from = self._learned_here(key)  # it may have been renamed or replaced meanwhile
        if learned_from is not demonstrations:
            raise Stopped
        content = replace(concept.concept, origin=replace(concept.concept.origin, name=before.name))
        learned = replace(former, changes=changes, steps=self._changed(steps))
        known, found = self._measured(replace(before, composition=concept, concept=content, learned=learned), concept)
        same = content.choice is None or content.choice.form == ONE  # learned quickly with the same settings
        if self._model.settings == OWN or not (same or _fewer(known.accuracy, before.accuracy)):
            self._newest = learned if self._newest is former else self._newest
            found |= self._keep(key, known)
        outliers = self._outliers
        warned = [] if outliers is None else several_concepts(self._model.model, demonstrations, outliers)
        tell({"done": True, "seconds": round(monotonic() - begin, 2), "check": warned} | found)

    def _invert(
        self,
        demonstrations: Demonstrations,
        changes: Mapping[str, Any],
        steps: int,
        stopped: Callable[[], bool],
        watch: Callable[[Learning], None] | None = None,
    ) -> LearnedConcept:
        def advance(steps: int = 1, note: str = "") -> None:
            if stopped():
                raise Stopped

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the page shows these warnings beside the demonstrations
            name = demonstrations.concepts[0]
            return self._model.learn(demonstrations, name=name, steps=steps, progress=advance, watch=watch, **changes)

    def _changed(self, steps: int) -> int | None:
        """Number of steps, ``None`` for the tuned number."""
        return None if steps == self._model.tuned.learning_steps else steps

    def _measured(self, known: Known, concept: LearnedConcept) -> tuple[Known, Json]:
        """A learned concept with its accuracy, and its samples and quality."""
        assert known.learned is not None
        assert known.demonstrations is not None
        shown, words = self._samples(concept, GENERATED, known.demonstrations, known.task)
        decided = [film["right"] for film in shown if film["right"] is not None]
        quality: Json = {"line": words, "numbers": {}}
        if len(known.demonstrations) > 1:
            measured = concept.quality.quality
            quality = {"line": ", ".join(filter(None, (words, measured.words))), "numbers": measured.numbers}
        if (maker := concept.uncomposed.made) is not None:
            quality["line"] += f". {concept.uncomposed.share:.0%} of the samples are {maker.name}, made without the model"
        same = self._same((Part(known.learned.label, learned=known.learned),), None)
        right = sum(decided) / len(decided) if decided else None
        return replace(known, accuracy=right), {"samples": shown[:SHOWN], "quality": quality, "same": same}

    def _keep(self, key: str, known: Known) -> Json:
        """Keep a learned concept under an identifier."""
        self._concepts[key] = known
        return {"done": True, "concept": self._content(key), "concepts": self._listed()}

    def _unused(self, name: str) -> str:
        """Label whose files and variable differ from those of every concept learned here."""
        taken = VARIABLES | {known.learned.variable for known in self._concepts.values() if known.learned}
        label, number = name, 2
        while Learned(name, label).variable in taken:
            label, number = f"{name} {number}", number + 1
        return label

    def _settings(self, quick: bool) -> tuple[dict[str, Any], int]:
        """Changes to the tuned settings, and steps. Only a single set of embeddings is learned quickly."""
        tuned, steps = self._model.tuned.inversion, self._model.tuned.learning_steps
        if not quick or tuned.modes.sets != 1 or tuned.adapter.rank:
            return {}, steps
        if self._model.settings == OWN:
            return dict(QUICK), QUICK_STEPS
        return {"form": PAPER}, steps

    # Samples.

    def sample(self, request: requests.Sample) -> Json:
        """Generate samples of a mixture. Raise UserError for an unknown concept or group, or if behaviour cannot be executed."""
        begin = monotonic()
        known = [self._known(part.id) for part in request.parts]
        width, plans = self._model.model.config.state_dim, self._domain.plans
        concepts, parts, examples = [], [], []
        for part, item in zip(request.parts, known, strict=True):
            weighted = part.weight * item.composition
            concepts.append(weighted.on(plans.grouped(part.groups), width) if part.groups else weighted)
            parts.append(Part(item.name, part.weight, tuple(part.groups), item.learned, item.file))
            if (shown_here := item.demonstrations) is not None:
                examples.append(replace(shown_here, concepts=(item.name,) * len(shown_here)))
        names = [item.name for item in known]
        mixed = functools.reduce(operator.add, concepts)
        shown, verdict, how = samples(self._model, mixed, names, examples, request, self._demonstrating.task)
        return {"samples": shown, "told": verdict, "seconds": round(monotonic() - begin, 3), "same": self._same(parts, how)}

    def _samples(self, concept: LearnedConcept, count: int, demonstrations: Demonstrations, task: str) -> tuple[list[Json], str]:
        """Films of samples of a newly learned concept, and the fraction of correct samples in words."""
        task, starts = starts_of(self._model, (task,), count, 0)
        plans = self._model.sample(concept, count, starts, seed=0, **sampling_of(self._model))
        judge = judge_of(self._model, [demonstrations])
        return judged(self._model.model, judge, plans, goal_of(judge, (concept.concept.origin.name,), task))

    def thumbnail(self, key: str) -> Json:
        """Film of a sample of a concept."""
        known = self._known(key)
        _, starts = starts_of(self._model, (known.name, self._demonstrating.task), 1, 0)
        plans = self._model.sample(known.composition, 1, starts, seed=0, **sampling_of(self._model))
        return {"film": films(self._domain, plans)[0]}

    def _same(self, parts: Sequence[Part], how: Sampled | None) -> Json:
        return {"python": python(self.name, parts, how), "command": command(self.name, self._model.settings, parts, how)}
