"""The demonstrations of one concept that a person has shown so far, by hand, from the library or from files."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from ftl_lightning.demonstrations.check import check
from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.domains.domain import Source
from ftl_lightning.domains.recorder import Recorder, Scene, expect_path
from ftl_lightning.errors import UserError, short
from ftl_lightning.few_shot import FewShot
from ftl_lightning.learning.demonstration_check import fit_findings
from ftl_lightning.play import requests
from ftl_lightning.play.films import Json, film, films

WANTED = 5
"""That a person is asked for."""
MOST, MOST_SCENES, MOST_UNDONE = 50, 50, 50
"""Demonstrations, scenes that are remembered, and steps that can be undone."""
FILES = (".npz", ".safetensors")
"""Endings of files of demonstrations, beside those of a domain's other programs."""


class Demonstrating:
    """Demonstrations, and the scenes that more of them can be shown in.

    Args:
        model: of whose domain they are.
        source: of the library; files of recordings may be missing.

    Attributes:
        task: that a scene or a demonstration was last asked for; empty for none.
    """

    def __init__(self, model: FewShot, source: Source) -> None:
        self._model, self._domain, self._source = model, model.domain, source
        self._own: list[tuple[int, Demonstrations]] = []
        self._before: list[list[tuple[int, Demonstrations]]] = []
        self._scenes: dict[int, Scene] = {}
        self._count = 0
        self._library: Json | None = None
        self.task = ""

    @property
    def name(self) -> str:
        """What the first one is called, where it came with a name; else empty."""
        return next((own.concepts[0] for _, own in self._own if own.concepts[0]), "")

    @property
    def library(self) -> Json:
        """Tasks of which demonstrations can be drawn, or why there are none."""
        if self._library is None:
            concepts = self._domain.concepts
            known = dict.fromkeys((*concepts.training, *(goal for suite in concepts.suites.values() for goal in suite.goals)))
            try:
                self._source.draw(next(iter(known)), 1, 0)
                self._library = {"tasks": list(known), "why": ""}
            except UserError as error:
                self._library = {"tasks": [], "why": f"This model comes without demonstrations to choose from: {error}"}
        return self._library

    @property
    def files(self) -> tuple[str, ...]:
        """Endings of files that are read."""
        return (*FILES, *self._domain.imports)

    def told(self) -> dict[str, Any]:
        """Films of them, what a check found in each and in all, and whether anything can be undone."""
        flags: dict[int, list[str]] = {}
        general: list[str] = []
        if self._own:
            own = self.together("demonstrations")
            found = (*check(own), *fit_findings(self._model.model, own))  # what the model knows of them takes longer
            for finding in (one for one in found if one.severity != "note"):
                for row in finding.rows:
                    flags.setdefault(row, []).append(finding.text)
                general += [] if finding.rows else [finding.text]
        shown = [
            {"id": number, "film": films(self._domain, own)[0], "flags": flags.get(row, [])}
            for row, (number, own) in enumerate(self._own)
        ]
        return {"demonstrations": shown, "check": general, "undo": bool(self._before), "wanted": WANTED}

    def together(self, name: str) -> Demonstrations:
        """All of them as demonstrations of one concept.

        Raises:
            UserError: if there are none.
        """
        if not self._own:
            raise UserError("demonstrations: expected one or more, found none; show the model something first")
        joined = concatenate([own for _, own in self._own])
        return replace(joined, concepts=(name,) * len(joined))

    def _recorder(self) -> Recorder:
        if (found := self._domain.recorder) is None:
            raise UserError(f"scene: expected a model whose behaviour is shown by hand, found one of {self._domain.name}")
        return found

    def scene(self, asked: requests.Pose) -> Json:
        """A new scene to show something in.

        Raises:
            UserError: in a domain where nothing is shown by hand, or for a task that has no scenes.
        """
        recorder = self._recorder()
        if asked.task and asked.task not in recorder.tasks:
            raise UserError(f"task: expected one of {len(recorder.tasks)} whose scenes can be drawn, found {short(asked.task)!r}")
        self._count += 1
        scene = recorder.scene(asked.task, self._count)
        self.task = asked.task or self.task
        self._scenes[self._count] = scene
        self._scenes = dict(list(self._scenes.items())[-MOST_SCENES:])
        pieces = [{"name": one.name, "at": list(one.at), "shapes": list(one.shapes)} for one in scene.pieces]
        told = {"film": film(scene.film), "pieces": pieces, "speed": scene.speed, "seconds": scene.seconds}
        return {"scene": self._count, **told}

    def record(self, asked: requests.Recorded) -> None:
        """What a hand did becomes a demonstration.

        Raises:
            UserError: for a scene that nobody asked for, or a path that shows nothing.
        """
        recorder = self._recorder()
        if (scene := self._scenes.get(asked.scene)) is None:
            raise UserError(f"scene: expected one that was asked for, found {asked.scene}; reload the page")
        self.add(recorder.record(scene, *expect_path(scene, asked.path, asked.seconds)))

    def draw(self, asked: requests.Drawn) -> None:
        """Others from the library: an expert's, or recordings.

        Raises:
            UserError: for a task of which there are none.
        """
        self._domain.expect_goal(asked.task, "task")
        self._count += 1
        self.add(self._source.draw(asked.task, asked.count, self._count))
        self.task = asked.task

    def read(self, name: str, content: bytes) -> None:
        """Those of a file.

        Args:
            name: of it, which says of which program it is.
            content: its bytes.

        Raises:
            UserError: for a file of no such program or of another domain, or a damaged one.
        """
        ending, stem = Path(name).suffix.lower(), Path(name).stem
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"file{ending}"
            path.write_bytes(content)
            try:
                imports = self._domain.imports.get(ending)
                self.add(self._model.demonstrations((imports or Demonstrations.load)(path), name=stem))
            except UserError as error:  # which names a file that the person does not know
                told = str(error).replace(str(path), short(Path(name).name))
                told = told if told.startswith(short(Path(name).name)) else f"{short(Path(name).name)}: {told}"
                raise UserError(told) from error

    def add(self, more: Demonstrations) -> None:
        """Take further ones, each on its own.

        Raises:
            UserError: where they become too many.
        """
        if len(self._own) + len(more) > MOST:
            raise UserError(f"demonstrations: expected at most {MOST} of a concept, found {len(self._own) + len(more)}")
        self._keep()
        for row in range(len(more)):
            self._count += 1
            self._own.append((self._count, more.rows([row])))

    def _keep(self) -> None:
        self._before = [*self._before, list(self._own)][-MOST_UNDONE:]

    def remove(self, asked: requests.One) -> None:
        """Go on without one.

        Raises:
            UserError: if it is not there.
        """
        if all(number != asked.id for number, _ in self._own):
            raise UserError(f"id: expected a demonstration that is there, found {asked.id}")
        self._keep()
        self._own = [(number, own) for number, own in self._own if number != asked.id]

    def undo(self) -> None:
        """Go back to what was there before the last change."""
        if self._before:
            self._own = self._before.pop()

    def clear(self) -> None:
        """Go on without any."""
        if self._own:
            self._keep()
        self._own = []


def as_npz(own: Demonstrations) -> bytes:
    """Demonstrations as an ``.npz`` file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demonstrations.npz"
        own.save(path)
        return path.read_bytes()
