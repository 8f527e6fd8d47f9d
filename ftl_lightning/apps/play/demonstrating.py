"""Demonstrations of a concept collected on the page: by hand, from the library or from files."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ftl_lightning.apps.play import requests
from ftl_lightning.apps.play.mixing import Json, film, films
from ftl_lightning.data.check import check
from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.domains.domain import Source
from ftl_lightning.domains.recorder import Recorder, Scene, check_path
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.training.checks import fit_findings

WANTED = 5  # number of demonstrations that the page asks for
MOST, MOST_SCENES, MOST_UNDONE = 50, 50, 50
"""Maximum number of demonstrations, of remembered scenes, and of changes that can be undone."""
GENERATED = "The model itself generates these demonstrations, because no recordings come with it."
FILES = (".npz", ".safetensors")  # suffixes of demonstration files, besides those of a domain's other programs


class Demonstrating:
    """Demonstrations of a concept for a model, and the scenes in which more can be recorded.

    Attributes:
        task: task of the last scene or demonstration drawn, or empty.

    Args:
        source: expert or recordings of the library.
        concepts: concepts of the model by name, whose samples replace recordings that are missing; empty for none.
    """

    def __init__(self, model: FewShot, source: Source, concepts: Mapping[str, Composition]) -> None:
        self._model, self._domain, self._source, self._concepts = model, model.domain, source, concepts
        self._entries: dict[int, Demonstrations] = {}
        self._before: list[dict[int, Demonstrations]] = []
        self._scenes: dict[int, Scene] = {}
        self._count = 0
        self._library: Json | None = None
        self.task = ""

    @property
    def name(self) -> str:
        """Name of the first demonstration that came with a name; else empty."""
        return next((entry.concepts[0] for entry in self._entries.values() if entry.concepts[0]), "")

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the present demonstrations."""
        return tuple(self._entries)

    @property
    def library(self) -> Json:
        """Tasks whose demonstrations can be drawn; ``why`` they are generated, or the reason why there are none."""
        if self._library is None:
            concepts = self._domain.concepts
            known = dict.fromkeys((*concepts.training, *(goal for suite in concepts.suites.values() for goal in suite.goals)))
            try:
                self._source.draw(next(iter(known)), 1, 0)
                self._library = {"tasks": list(known), "why": ""}
            except UserError as error:
                why = GENERATED if self._concepts else f"This model comes without demonstrations to choose from: {error}"
                self._library = {"tasks": list(self._concepts), "why": why}
        return self._library

    @property
    def files(self) -> tuple[str, ...]:
        """Suffixes of readable files."""
        return (*FILES, *self._domain.recordings.imports)

    def report(self) -> dict[str, Any]:
        """Films, findings of the check for each demonstration and for all, and whether a change can be undone."""
        flags: dict[int, list[str]] = {}
        general: list[str] = []
        if self._entries:
            joined = self.together("demonstrations")
            findings = (*check(joined), *fit_findings(self._model.model, joined))
            for finding in (item for item in findings if item.severity != "note"):
                for row in finding.rows:
                    flags.setdefault(row, []).append(finding.text)
                general += [] if finding.rows else [finding.text]
        entries = [
            {"id": number, "film": films(self._domain, entry)[0], "flags": flags.get(row, [])}
            for row, (number, entry) in enumerate(self._entries.items())
        ]
        return {"demonstrations": entries, "check": general, "undo": bool(self._before), "wanted": WANTED, "name": self.name}

    def together(self, name: str) -> Demonstrations:
        """Demonstrations joined under the concept ``name``. Raise UserError if there are none."""
        require(self._entries, "demonstrations", "one or more", "none; show the model something first")
        joined = concatenate(list(self._entries.values()))
        return replace(joined, concepts=(name,) * len(joined))

    def _recorder(self) -> Recorder:
        if (recorder := self._domain.recordings.recorder) is None:
            raise UserError(f"scene: expected a model whose behaviour is shown by hand, found {self._domain.name}")
        return recorder

    def scene(self, request: requests.Pose) -> Json:
        """Draw a new scene to record in. Raise UserError in a domain without a recorder, or for a task without scenes."""
        recorder = self._recorder()
        expected = f"one of {len(recorder.tasks)} whose scenes can be drawn"
        require(not request.task or request.task in recorder.tasks, "task", expected, short(request.task))
        self._count += 1
        scene = recorder.scene(request.task, self._count)
        self.task = request.task or self.task
        self._scenes[self._count] = scene
        self._scenes = dict(list(self._scenes.items())[-MOST_SCENES:])
        pieces = [{"name": piece.name, "at": list(piece.at), "shapes": list(piece.shapes)} for piece in scene.pieces]
        content = {"film": film(scene.film), "pieces": pieces, "speed": scene.speed, "seconds": scene.seconds}
        return {"scene": self._count, **content}

    def record(self, request: requests.Recorded) -> None:
        """Add a demonstration recorded by hand. Raise UserError for an unknown scene, or a path that shows nothing."""
        recorder = self._recorder()
        require(request.scene in self._scenes, "scene", "a scene drawn before", f"{request.scene}; reload the page")
        scene = self._scenes[request.scene]
        self.add(recorder.record(scene, *check_path(scene, request.path, request.seconds)))

    def draw(self, request: requests.Drawn) -> None:
        """Add demonstrations of a task from the expert, the recordings or the model. Raise UserError for a task without any."""
        self._domain.check_goal(request.task, "task")
        self._count += 1
        generated = self.library["why"] == GENERATED
        self.add((self._generated if generated else self._source.draw)(request.task, request.count, self._count))
        self.task = request.task

    def _generated(self, task: str, count: int, seed: int) -> Demonstrations:
        """Samples of a concept of the model from new initial states."""
        require(task in self._concepts, "task", "a concept of this model", short(task))
        starts = self._domain.source(None).starts(task, count, seed) if self._domain.observed else None
        plans = self._model.sample(self._concepts[task], count, starts, seed=seed)
        return replace(plans, concepts=(task,) * len(plans))

    def read(self, name: str, content: bytes) -> None:
        """Add the demonstrations of a file, whose suffix determines the program; damaged files and other domains are refused."""
        ending, stem = Path(name).suffix.lower(), Path(name).stem
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"file{ending}"
            path.write_bytes(content)
            try:
                imports = self._domain.recordings.imports.get(ending)
                self.add(self._model.demonstrations((imports or Demonstrations.load)(path), name=stem))
            except UserError as error:  # names the temporary file
                file = short(Path(name).name)
                raise UserError(f"{file}: {str(error).replace(str(path), file).removeprefix(f'{file}: ')}") from error

    def add(self, more: Demonstrations) -> None:
        """Append demonstrations as separate entries, at most :data:`MOST` in all."""
        count = len(self._entries) + len(more)
        require(count <= MOST, "demonstrations", f"at most {MOST} of a concept", count)
        self._change(self._entries | {self._count + row + 1: more.rows([row]) for row in range(len(more))})
        self._count += len(more)

    def _change(self, entries: dict[int, Demonstrations]) -> None:
        self._before = [*self._before, self._entries][-MOST_UNDONE:]
        self._entries = entries

    def remove(self, request: requests.One) -> None:
        """Remove an existing demonstration."""
        require(request.id in self._entries, "id", "an existing demonstration", request.id)
        self._change({number: entry for number, entry in self._entries.items() if number != request.id})

    def undo(self, request: requests.Nothing) -> None:
        """Undo the last change."""
        if self._before:
            self._entries = self._before.pop()

    def clear(self, request: requests.Nothing) -> None:
        """Remove all demonstrations."""
        if self._entries:
            self._change({})


def as_npz(demonstrations: Demonstrations) -> bytes:
    """Demonstrations as an ``.npz`` file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demonstrations.npz"
        demonstrations.save(path)
        return path.read_bytes()
