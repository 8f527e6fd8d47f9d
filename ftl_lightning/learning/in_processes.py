"""Learning many concepts in several processes, each its share of them. Concepts do not depend on what is learned beside them."""

import multiprocessing
import tempfile
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import torch

from ftl_lightning import trust
from ftl_lightning.concepts.concept import Concept
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError
from ftl_lightning.learning.inversion_settings import InversionSettings
from ftl_lightning.learning.pretrained import load_model
from ftl_lightning.printing import silence
from ftl_lightning.progress import bar


@dataclass(frozen=True)
class _Share:
    """What one process learns.

    Attributes:
        folder: where it finds the demonstrations and writes its concepts.
        model: folder or name of the pretrained one.
        concepts: their texts, with the number of each one's file.
        settings: how.
        steps: of gradient descent.
        device: to learn on.
        vouched: modules that a person named.
    """

    folder: str
    model: str
    concepts: tuple[tuple[int, str], ...]
    settings: InversionSettings
    steps: int
    device: str
    vouched: frozenset[str]


def learned_in_processes(
    model: str,
    demonstrations: Demonstrations,
    settings: InversionSettings,
    steps: int,
    processes: int,
    devices: Iterable[torch.device] = (torch.device("cpu"),),
) -> dict[str, Concept]:
    """The concepts that the model's learner makes of some demonstrations, learned in several processes.

    They are those of one process but for rounding: sums are taken over other numbers of rows.

    Args:
        model: folder or name of the pretrained one.
        demonstrations: with concept texts, which name the concepts.
        settings: how.
        steps: of gradient descent.
        processes: at most; there are no more than concepts.
        devices: processes take them in turn.

    Raises:
        UserError: what the learner raises; or that a process ended before it was done.
    """
    names, devices = tuple(dict.fromkeys(demonstrations.concepts)), tuple(devices)
    numbered = tuple(enumerate(names))
    with tempfile.TemporaryDirectory() as folder:
        demonstrations.save(Path(folder) / _DEMONSTRATIONS)
        shares = [
            _Share(folder, model, numbered[first::processes], settings, steps, str(devices[first % len(devices)]), trust.vouched())
            for first in range(min(processes, len(names)))
        ]
        # Started anew: a process that is split off would share the threads and devices of this one.
        with (
            ProcessPoolExecutor(len(shares), multiprocessing.get_context("spawn")) as pool,
            bar("concepts", len(names)) as advance,
        ):
            running = {pool.submit(_learn, share): len(share.concepts) for share in shares}
            try:
                for ended in as_completed(running):
                    if mistake := ended.result():
                        raise UserError(mistake)
                    advance(running[ended])
            except BrokenProcessPool:
                raise UserError(f"trainer.processes: expected {len(shares)} processes to the end, one was stopped") from None
        return {name: Concept.load(_file(folder, number)) for number, name in numbered}


_DEMONSTRATIONS = "demonstrations.safetensors"


def _file(folder: str, number: int) -> Path:
    return Path(folder) / f"{number}.safetensors"


def _learn(share: _Share) -> str:
    """Write a share's concepts; returns a mistake of the user's, or nothing."""
    silence()  # the first process has said what there is to say of the demonstrations
    torch.set_num_threads(1)
    with trust.vouching(share.vouched):
        try:
            model = load_model(share.model).to(share.device)
            every = Demonstrations.load(Path(share.folder) / _DEMONSTRATIONS)
            names = {name for _, name in share.concepts}
            own = every.rows([row for row, name in enumerate(every.concepts) if name in names])
            found = model.method.learn()(model, own, share.settings, share.steps)
            for number, name in share.concepts:
                found[name].save(_file(share.folder, number))
        except UserError as error:
            return str(error)
    return ""
