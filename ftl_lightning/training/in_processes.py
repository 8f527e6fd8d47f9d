"""Learning concepts in several processes. Concepts do not depend on others in the batch."""

import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.settings import InversionSettings
from ftl_lightning.services import trust
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.text import silence
from ftl_lightning.training.model_folder import load_model


@dataclass(frozen=True)
class _Share:
    """Work of a process: file numbers and texts of concepts, and the folder of demonstrations and learned concepts."""

    folder: str
    model: str
    concepts: tuple[tuple[int, str], ...]
    settings: InversionSettings
    steps: int
    device: str
    trusted: frozenset[str]


def learned_in_processes(
    model: str, device: torch.device, demonstrations: Demonstrations, settings: InversionSettings, steps: int, processes: int
) -> dict[str, Concept]:
    """Learn the concepts of the demonstrations in several processes.

    Results equal those of a single process up to rounding, as batches have other sizes.

    Args:
        model: folder or name of the pretrained model.
        device: device to learn on; with several GPUs, processes take them in turn.
        demonstrations: demonstrations; their concept texts name the concepts.
        processes: maximum number of processes; never above the number of concepts.

    Raises:
        UserError: raised by the learner, or if a process ended early.
    """
    names = tuple(dict.fromkeys(demonstrations.concepts))
    devices = [torch.device("cuda", number) for number in range(torch.cuda.device_count())] if device.type == "cuda" else [device]
    numbered, trusted = tuple(enumerate(names)), trust.trusted_names()
    with tempfile.TemporaryDirectory() as folder:
        demonstrations.save(Path(folder) / _DEMONSTRATIONS)
        shares = [
            _Share(folder, model, numbered[first::processes], settings, steps, str(devices[first % len(devices)]), trusted)
            for first in range(min(processes, len(names)))
        ]
        # Spawned, since a forked process would share threads and devices.
        with ProcessPoolExecutor(len(shares), multiprocessing.get_context("spawn")) as pool, bar("concepts", len(names)) as advance:
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
    """Learn and write a share's concepts; return the message of a ``UserError``, or an empty string."""
    silence()  # the first process has printed all notes
    torch.set_num_threads(1)
    with trust.vouching(share.trusted):
        try:
            model = load_model(share.model).to(share.device)
            loaded = Demonstrations.load(Path(share.folder) / _DEMONSTRATIONS)
            names = {name for _, name in share.concepts}
            demonstrations = loaded.rows([row for row, name in enumerate(loaded.concepts) if name in names])
            learned = model.learn_concepts(demonstrations, share.settings, share.steps)
            for number, name in share.concepts:
                learned[name].save(_file(share.folder, number))
        except UserError as error:
            return str(error)
    return ""
