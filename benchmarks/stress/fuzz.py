"""Fuzz the readers of files: read mutated files like users' files, and count the outcomes.

    python benchmarks/stress/fuzz.py --kind config.json --count 1000 --seed 0

Outcomes: ``ok`` (the file is read and used), ``UserError`` (refused in one line of a bearable length), ``other`` (any other
exception; the first case of each is printed), ``slow`` (more than 5 s), ``memory`` (more than 1 GB more than before) and ``crash``
(the process died). A seed and a number give the same file on every machine.
"""

import argparse
import collections
import contextlib
import copy
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import struct
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # others reserve more than the limit

import h5py
import numpy as np
import pandas as pd
import safetensors.torch
import scipy.io
import torch
import yaml

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.mocap.bvh import bvh
from ftl_lightning.domains.mocap.prepare import demonstrated
from ftl_lightning.domains.mocap.skeleton import standing_poses
from ftl_lightning.evaluation.results import COLUMNS, latest, read_rows
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.concept import Concept, Origin
from ftl_lightning.igm.forms.adapter import LowRank, adaptable
from ftl_lightning.igm.forms.modes import Modes
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.services.configuration import load
from ftl_lightning.services.errors import LONGEST, UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.shipped import pretrained_folder
from ftl_lightning.training.checkpoint import read_checkpoint
from ftl_lightning.training.checks import check_concept
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

SLOW, MEMORY = 5.0, 2**30
HEADER = "ftl_lightning"
FOREIGN = ("npy", "json", "mat", "h5", "pt", "csv", "parquet")
MODELS = ("driving", "agent", "object_rearrangement", "baseline/cvae/driving", "baseline/in_context/driving", "baseline/bc/driving")
ODD: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 10_000_000, 10**9, 10**30, 2**63, 0.5, -0.0, 1e308, 1e-320, float("nan"), float("inf")),
    *("", "abc", "3", "own", "os:path", "\ud800", "\x00\n\x1b[0m", "x" * 5000, "../../etc", "${x}", "entities", "TemporalUNet"),
    *([], {}, [1], [[1]], [None], ["a"], [[]], {"a": 1}, [10**9] * 3, list(range(300)), {"shape": [3]}, [[0, 1], [2]]),
)


def mutated(tree: Any, draw: random.Random) -> Any:
    """A copy of what JSON holds, with one or a few places changed."""
    tree = copy.deepcopy(tree)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        holder, key = _place(tree, draw)
        if holder is None:
            return copy.deepcopy(draw.choice(ODD))
        action = draw.random()
        if action < 0.55:
            holder[key] = copy.deepcopy(draw.choice(ODD))
        elif action < 0.65 and isinstance(holder, dict):
            holder[draw.choice(("unknown", "", "depth", "kind", "ħ"))] = copy.deepcopy(draw.choice(ODD))
        elif action < 0.75:
            del holder[key]
        elif action < 0.85:
            holder[key] = [holder[key]]
        elif action < 0.9:
            for _ in range(draw.choice((3, 60, 900))):
                holder[key] = {"a": holder[key]} if draw.random() < 0.5 else [holder[key]]
        elif isinstance(holder[key], int) and not isinstance(holder[key], bool):
            holder[key] = holder[key] * draw.choice((2, 10, -1, 1000)) + draw.choice((0, 1, -1))
        else:
            holder[key] = str(holder[key])
    return tree


def _place(tree: Any, draw: random.Random) -> tuple[Any, Any]:
    """A list or mapping somewhere, and an index or key of it."""
    holder = tree
    while isinstance(holder, dict | list) and holder:
        key = draw.choice(list(holder)) if isinstance(holder, dict) else draw.randrange(len(holder))
        if not isinstance(holder[key], dict | list) or not holder[key] or draw.random() < 0.5:
            return holder, key
        holder = holder[key]
    return None, None


def flipped(content: bytes, draw: random.Random) -> bytes:
    """Some bytes changed, left out or added."""
    found = bytearray(content)
    action = draw.random()
    if action < 0.15:
        return bytes(found[: draw.randrange(len(found) + 1)])
    if action < 0.3:
        at = draw.randrange(len(found) + 1)
        return bytes(found[:at] + draw.randbytes(draw.choice((1, 8, 100))) + found[at:])
    # Mostly at the front, where headers are.
    reach = len(found) if draw.random() < 0.4 else min(len(found), 600)
    for _ in range(draw.choice((1, 1, 2, 8))):
        found[draw.randrange(reach)] = draw.choice((draw.randrange(256), 0, 0xFF, 0x30))
    return bytes(found)


def _flipped_footer(content: bytes, draw: random.Random) -> bytes:
    """The same of a Parquet file, whose header is at its end."""
    if draw.random() < 0.5:
        return flipped(content, draw)
    at = max(0, len(content) - 3000)
    return content[:at] + flipped(content[at:], draw)


def as_json(tree: Any, draw: random.Random) -> bytes:
    """A mutated tree as text, maybe with a key twice or bytes changed."""
    text = json.dumps(mutated(tree, draw))
    if draw.random() < 0.05 and text.startswith("{"):
        text = '{"kind": "diffusion", "horizon": 3, ' + text[1:]
    return flipped(text.encode(), draw) if draw.random() < 0.15 else text.encode()


def as_yaml(tree: Any, draw: random.Random) -> bytes:
    """A mutated tree as YAML, maybe with aliases, tags or bytes changed."""
    try:
        text = yaml.safe_dump(mutated(tree, draw) if draw.random() < 0.8 else tree, allow_unicode=True)
    except RecursionError:  # too deep to be written
        text = "[" * 5000
    more = ("", "", "", "x: &a [1, 2]\ny: [*a, *a]\n", "z: !!python/object/apply:os.system ['true']\n", "? [1]\n: 2\n", "\t- x\n")
    content = (text + draw.choice(more)).encode(errors="surrogatepass")
    return flipped(content, draw) if draw.random() < 0.3 else content


def odd_tensor(value: torch.Tensor, draw: random.Random) -> torch.Tensor:
    """A tensor in place of another."""
    kinds: list[Callable[[], torch.Tensor]] = [
        lambda: value.double(),
        lambda: value.to(torch.uint8),
        lambda: value.half(),
        lambda: value.bool(),
        lambda: value.flatten(),
        lambda: value[:0],
        lambda: value[:1],
        lambda: value[..., :1],
        lambda: value[None],
        lambda: torch.zeros(()),
        lambda: torch.cat((value, value)),
        lambda: torch.full_like(value.float(), draw.choice((float("nan"), float("inf"), 1e38, -1, 0))),
        lambda: value.to(torch.bfloat16),
        lambda: value.to(torch.int64),
    ]
    return draw.choice(kinds)() if value.dim() else torch.zeros(3)


def odd_safetensors(content: bytes, draw: random.Random) -> bytes:
    """A safetensors file with another header, other tensors, or bytes changed."""
    action = draw.random()
    if action < 0.2:
        return flipped(content, draw)
    tensors = safetensors.torch.load(content)
    (length,) = struct.unpack("<Q", content[:8])
    outer = json.loads(content[8 : 8 + length])
    if action < 0.3:  # the form's own header
        text = json.dumps(mutated(outer, draw)).encode()
        return struct.pack("<Q", len(text)) + text + content[8 + length :]
    header = json.loads(outer["__metadata__"][HEADER])
    if action < 0.65:
        header_text = as_json(header, draw).decode("utf-8", errors="replace")
    else:
        header_text = json.dumps(header)
        for _ in range(draw.choice((1, 1, 2))):
            name = draw.choice(sorted(tensors))
            if draw.random() < 0.2:
                tensors.pop(name)
            elif draw.random() < 0.2:
                tensors[draw.choice(("more", "observed/x", "adapter/x", "adapter/x/up", "mode_weights"))] = tensors[name].clone()
            else:
                tensors[name] = odd_tensor(tensors[name], draw)
            if not tensors:
                break
    return safetensors.torch.save({name: one.clone().contiguous() for name, one in tensors.items()}, {HEADER: header_text})


def odd_npz(arrays: dict[str, Any], draw: random.Random) -> bytes:
    """An ``.npz`` with other arrays, headers of arrays, or bytes changed."""
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    action = draw.random()
    if action < 0.6:
        name = draw.choice(list(arrays))
        value = arrays[name]
        kinds: list[Callable[[], Any]] = [
            lambda: value.astype(object),
            lambda: value[:0],
            lambda: value[:1],
            lambda: value[None],
            lambda: np.array(draw.choice((float("nan"), 1e39, -1, 0, "abc", b"abc", 1j, True, np.datetime64("2020-01-01")))),
            lambda: np.full(value.shape, draw.choice((np.nan, np.inf, 1e300, 2.7, 0, -5))),
            lambda: np.full(value.shape, draw.choice(("", "\udc00", "x" * 999))),
            lambda: value.astype("S"),
            lambda: value.astype("U"),
            lambda: np.zeros((10**7,), np.uint8),
            lambda: np.array([("a", 1)], dtype=[("x", "U1"), ("y", "i4")]),
        ]
        arrays[draw.choice((name, name, "observed/x", "more"))] = draw.choice(kinds)()
        if draw.random() < 0.2:
            arrays.pop(draw.choice(list(arrays)))
    file = io.BytesIO()
    (np.savez_compressed if draw.random() < 0.5 else np.savez)(file, **arrays)
    content = file.getvalue()
    if action > 0.85:
        return flipped(content, draw)
    if action > 0.6:
        return _odd_archive(content, draw)
    return content


def odd_foreign(kind: str, arrays: dict[str, Any], draw: random.Random) -> bytes:
    """Arrays or a table of another program, with other values or bytes changed."""
    file, odd = io.BytesIO(), draw.random() < 0.6
    tree = {name: value.tolist() for name, value in arrays.items()}
    if kind == "json":
        return as_json(tree, draw)
    if kind in ("csv", "parquet"):
        times = [(demo, time) for demo in range(3) for time in range(6)]
        rows = [[str(demo), str(time), "abc"[demo], str(demo + 0.5), str(time)] for demo, time in times]
        names = ["demonstration", "time", "concept", "x", "y"]
        if kind == "csv":
            return odd_csv([names, *rows], draw)
        table = pd.read_csv(io.StringIO("\n".join(map(",".join, [names, *rows]))))
        if odd:
            cell: Any = draw.choice((None, 1, "abc", 0.5, [1, 2], float("nan"), True, b"x", pd.Timestamp(0)))
            table[draw.choice(names)] = [cell] * len(table)
        return table.to_parquet() if odd else _flipped_footer(table.to_parquet(), draw)
    if kind == "npy":
        np.save(file, arrays["states"])
    elif kind == "pt":
        tensors = {name: torch.from_numpy(value) if value.dtype.kind != "U" else value.tolist() for name, value in arrays.items()}
        with contextlib.suppress(RecursionError):  # too deep to be written
            torch.save(tensors | ({draw.choice(list(tree)): mutated(tree, draw)} if odd else {}), file)
    elif kind == "mat":
        texts = {
            name: np.array(value.tolist(), dtype=object) if value.dtype.kind == "U" else value for name, value in arrays.items()
        }
        name = draw.choice(list(texts))
        other = draw.choice((1.5, "abc", [1, "a"], {"a": {"b": 1}}, np.array([[[1]], "b", {}], dtype=object), texts[name][:1]))
        scipy.io.savemat(file, texts | ({name: other} if odd else {}), do_compression=draw.random() < 0.5)
    else:
        with h5py.File(file, "w") as group:
            for name, value in arrays.items():
                group[name] = value.tolist() if value.dtype.kind == "U" else value
    return flipped(file.getvalue(), draw) if not odd or draw.random() < 0.2 else file.getvalue()


def _odd_archive(content: bytes, draw: random.Random) -> bytes:
    """The same with one array's header that names another shape, or its member encrypted, twice or of another kind."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        chosen = draw.choice(old.namelist())
        for name in old.namelist():
            data = old.read(name)
            if name == chosen:
                shape = draw.choice((b"(1000000000000,)", b"(-1, 3)", b"(3, 4", b"(10**9,)", b"()", b"(1000, 1000, 3000)"))
                start, end = data.index(b"'shape': ") + 9, data.index(b"}")
                changed = data[:start] + shape
                data = draw.choice((changed + data[end:], b"plain bytes", b"", changed + b", " + data[end:]))
                if draw.random() < 0.2:
                    new.writestr(name, data)
            new.writestr(draw.choice((name, name, name.removesuffix(".npy"))), data)
    found = file.getvalue()
    if draw.random() < 0.3:  # encrypted, as the flags in both headers say
        return found.replace(b"PK\x03\x04\x14\x00\x00\x00", b"PK\x03\x04\x14\x00\x01\x00").replace(
            b"PK\x01\x02\x14\x03\x14\x00\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01\x00"
        )
    return found


def odd_csv(rows: list[list[str]], draw: random.Random) -> bytes:
    """A results file with other cells, rows or columns, or bytes changed."""
    rows = [list(row) for row in rows]
    cells = ["abc", "", "nan", "inf", "-inf", "1e999", "-1", "0.5", "1e3", "True", "9" * 30, "\x00", '"', ",", "é", "\n", "0x10"]
    for _ in range(draw.choice((1, 1, 2))):
        row, action = draw.choice(rows), draw.random()
        if action < 0.7:
            row[draw.randrange(len(row))] = draw.choice(cells)
        elif action < 0.8:
            row.append("more")
        elif action < 0.9 and len(row) > 1:
            row.pop(draw.randrange(len(row)))
        else:
            for one in rows:
                one.append("more")
    content = "\n".join(",".join(row) for row in rows).encode()
    return flipped(content, draw) if draw.random() < 0.25 else content


def odd_hdf5(path: Path, draw: random.Random) -> None:
    """Put a link, another array or nothing in place of an object of an HDF5 file."""
    import h5py

    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visit(names.append)
        name = draw.choice(names)
        values = draw.choice((1.0, "text", [1, 2], [[1e300] * 2] * 6, ["a"] * 6, [True] * 6))
        kinds: list[Callable[[], object]] = [
            lambda: file.__setitem__(name, h5py.SoftLink(draw.choice(("/", "/episode_0", "/nowhere", name)))),
            lambda: file.__setitem__(name, h5py.ExternalLink("/etc/hostname", "/x")),
            lambda: file.__setitem__(name, file[draw.choice(("/", "/episode_1", "/episode_2/observations"))]),
            lambda: file.create_dataset(name, (3, 2), "f4", external=[("/etc/hostname", 0, 24)]),
            lambda: file.create_dataset(name, (10**10, 2), "f4"),
            lambda: file.create_dataset(name, (10**9,), "f8", compression="gzip"),
            lambda: file.create_dataset(name, data=values),
            lambda: file.create_dataset(name, dtype="f4"),
            lambda: file.create_group(name),
            lambda: None,
        ]
        del file[name]
        with contextlib.suppress(KeyError, ValueError, OSError, RuntimeError, TypeError):  # a link to what was deleted
            draw.choice(kinds)()


class Fuzz:
    """Good files of every kind, and how each kind is mutated, read and used."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.model = load_model("agent")
        assert isinstance(self.model, GenerativeModel)
        n, config = self.model.config.concept_dim, self.model.config
        origin = Origin("go", config.domain, config.encoder, self.model.hash, "0" * 16, 5, "fixed", 0.1)
        weight, (outputs, inputs) = next(iter(adaptable(self.model.denoiser).items()))
        embeddings, modes = torch.randn(2, 1, n), Modes(torch.randn(3, 2, 1, n), torch.ones(3, 2))
        adapter = LowRank({weight: (torch.zeros(outputs, 2), torch.zeros(2, inputs))})
        self.concepts = [
            self._bytes(Concept(embeddings, torch.ones(2), origin, **options).save)
            for options in ({}, {"modes": modes}, {"adapter": adapter})
        ] + [self._bytes(Concept(torch.randn(2, 3, n), torch.ones(2), origin).save)]
        self.arrays = {
            "states": np.random.default_rng(0).normal(size=(3, 6, 2)).astype(np.float32),
            "lengths": np.array([6, 5, 4]),
            "concepts": np.array(["a", "b", "c"]),
            "per_step": np.array(["place"]),
            "observed/place": np.zeros((3, 6, 2)),
            "observed/photo": np.zeros((3, 3, 8, 8), np.uint8),
            "scenes": np.ones((3, 2)),
        }
        np.savez(folder / "good.npz", **self.arrays)  # type: ignore[arg-type]
        self.demonstrations = self._bytes(Demonstrations.load(folder / "good.npz").save)
        numbers = ["accuracy", "0.5", "a" * 16, "b" * 16, "1.0"]
        own = ["agent", "paper", "go", "BC", "", "", "method", "1", "1.2", "5", "0", "10", *numbers]
        self.rows = [COLUMNS, own, [*own[:10], "1", *own[11:]]]
        self.kinds: dict[str, Callable[[random.Random], None]] = {
            "config.json": self.config,
            "concept": self.concept,
            "safetensors": self.safetensors,
            "npz": self.npz,
            "lerobot": self.lerobot,
            "lerobot v2.1": self.lerobot_old,
            "minari": self.minari,
            "bvh": self.bvh,
            "results.csv": self.csv,
            "checkpoint": self.checkpoint,
            "yaml": self.yaml,
            **{kind: partial(self.foreign, kind) for kind in FOREIGN},
        }

    def _bytes(self, save: Callable[[Path], None]) -> bytes:
        save(self.folder / "good.safetensors")
        return (self.folder / "good.safetensors").read_bytes()

    def _written(self, name: str, content: bytes) -> Path:
        path = self.folder / name
        path.write_bytes(content)
        return path

    def config(self, draw: random.Random) -> None:
        """A pretrained model's ``config.json`` beside its weights."""
        source = pretrained_folder(draw.choice(MODELS))
        tree = json.loads((source / "config.json").read_text())
        if draw.random() < 0.7:  # what is built, not the record of how
            tree["training"] = {}
        weights = self.folder / "model.safetensors"
        weights.unlink(missing_ok=True)
        weights.symlink_to((source / weights.name).resolve())
        self._written("config.json", as_json(tree, draw))
        _sampled(load_model(self.folder))

    def concept(self, draw: random.Random) -> None:
        """A learned concept, checked against its model and sampled from."""
        path = self._written("concept.safetensors", odd_safetensors(draw.choice(self.concepts), draw))
        found = Concept.load(path)
        check_concept(self.model, found, path)
        _sampled(self.model, found)
        found.save(self.folder / "again.safetensors")

    def safetensors(self, draw: random.Random) -> None:
        """Demonstrations."""
        self._used(self._written("demonstrations.safetensors", odd_safetensors(self.demonstrations, draw)))

    def npz(self, draw: random.Random) -> None:
        """The same as ``.npz``."""
        self._used(self._written("demonstrations.npz", odd_npz(self.arrays, draw)))

    def lerobot(self, draw: random.Random) -> None:
        """The same as the folder of a LeRobot data set, one file of which is changed."""
        folder = self.folder / "lerobot"
        if not folder.is_dir():
            Demonstrations.load(self.folder / "good.npz").save(f"lerobot:{folder}")
        self._changed(folder, folder, draw)

    def lerobot_old(self, draw: random.Random) -> None:
        """The same of version 2.1, whose episodes and tasks are lines of JSON."""
        folder = self.folder / "lerobot_old"
        if not folder.is_dir():
            Demonstrations.load(self.folder / "good.npz").save(f"lerobot:{folder}")
            meta = folder / "meta"
            content = json.loads((meta / "info.json").read_text())
            (meta / "info.json").write_text(json.dumps(content | {"codebase_version": "v2.1"}))
            episodes = [{"episode_index": number, "tasks": ["a"], "length": 6 - number} for number in range(3)]
            (meta / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in episodes))
            tasks = [{"task_index": number, "task": text} for number, text in enumerate("abc")]
            (meta / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in tasks))
            shutil.rmtree(meta / "episodes")
            (meta / "tasks.parquet").unlink()
        self._changed(folder, folder, draw)

    def minari(self, draw: random.Random) -> None:
        """The same as the folder of a Minari data set, one file of which is changed, or an object of its HDF5 file."""
        os.environ["MINARI_DATASETS_PATH"] = str(self.folder)
        folder = self.folder / "good-v0" / "data"
        if not folder.is_dir():
            Demonstrations.load(self.folder / "good.npz").save("minari:good-v0")
        if draw.random() < 0.5:
            self._changed(folder, "good-v0", draw)
            return
        path = folder / "main_data.hdf5"
        content = path.read_bytes()
        try:
            odd_hdf5(path, draw)
            self._used("good-v0")
        finally:
            path.write_bytes(content)

    def bvh(self, draw: random.Random) -> None:
        """Motion of a person, with words in place of others, or bytes changed."""
        text = bvh(standing_poses(1, torch.Generator().manual_seed(0)).repeat(40, 1))
        words = re.split(r"(\s+)", text)
        odd = ("", "nan", "1e308", "-1", "0", "1e5", "1e-5", "}", "{", "JOINT", "MOTION", "9" * 5000, "999999", "6", "\ufeff")
        for _ in range(draw.choice((0, 1, 1, 2, 8))):
            words[draw.randrange(min(len(words), 400) if draw.random() < 0.7 else len(words))] = draw.choice(odd)
        content = "".join(words).encode()
        demonstrated(self._written("motion.bvh", flipped(content, draw) if draw.random() < 0.3 else content))

    def _changed(self, folder: Path, name: str | Path, draw: random.Random) -> None:
        """Read demonstrations by their name while a file of their folder is changed."""
        path = draw.choice(sorted(one for one in folder.rglob("*") if one.is_file()))
        content = path.read_bytes()
        if path.suffix == ".json":
            changed = as_json(json.loads(content), draw)
        elif path.suffix == ".jsonl":
            changed = b"\n".join(as_json(json.loads(row), draw) for row in content.splitlines())
        else:
            changed = _flipped_footer(content, draw)
        path.write_bytes(changed)
        try:
            self._used(name)
        finally:
            path.write_bytes(content)

    def foreign(self, kind: str, draw: random.Random) -> None:
        """Arrays or a table of another program."""
        self._used(self._written(f"foreign.{kind}", odd_foreign(kind, self.arrays, draw)))

    def _used(self, path: str | Path) -> None:
        found = Demonstrations.load(path).named("file")
        rows = torch.arange(len(found))
        found.windows(rows, torch.zeros_like(rows), 3)
        found.save(self.folder / "again.safetensors")
        assert Demonstrations.load(self.folder / "again.safetensors").hash == found.hash

    def csv(self, draw: random.Random) -> None:
        """A results file."""
        found = read_rows(self._written("results.csv", odd_csv(self.rows, draw)))
        assert np.isfinite(latest(found)["value"].to_numpy(dtype=float)).all()

    def checkpoint(self, draw: random.Random) -> None:
        """A checkpoint with other content, or with bytes changed."""
        weights = {"weight": torch.ones(3), "bias": torch.zeros(1)}
        state = {"state": {0: {"step": torch.ones(()), "exp_avg": torch.ones(3)}}, "param_groups": [{"lr": 0.1, "params": [0, 1]}]}
        tree = {"state_dict": weights, "epoch": 1, "global_step": 7, "loops": {"fit_loop": {"epoch": 1}}, "callbacks": {}}
        tree |= {"optimizer_states": [state], "lr_schedulers": [{"last_epoch": 7}], "belongs_to": {"class": "x"}, "random": {}}
        file = io.BytesIO()
        try:
            torch.save(mutated(tree, draw) if draw.random() < 0.6 else tree, file)
        except RecursionError:  # too deep to be written
            torch.save(tree, file)
        content = file.getvalue()
        read_checkpoint(self._written("own.ckpt", flipped(content, draw) if draw.random() < 0.5 else content))

    def yaml(self, draw: random.Random) -> None:
        """A configuration that builds on another one."""
        own = {"defaults": ["below.yaml"], "model": {"init_args": {"omega": 1.2, "names": ["a", "b"]}}, "trainer": {"max_steps": 3}}
        self._written("below.yaml", as_yaml({"model": {"class_path": "x.Y", "init_args": {"omega": 1}}}, draw))
        load(self._written("own.yaml", as_yaml(own, draw)))


def _sampled(model: ConceptModel, concept: Concept | None = None) -> None:
    """Draw a sample from a model."""
    observed = {name: torch.zeros(1, *feature.shape) for name, feature in model.domain.observed.items()}
    composition = Composition(model.training_embeddings[:1, None], torch.ones(1)) if concept is None else concept.composition
    model.sample([composition], 1, Sampling("ddim", 1), [generator("cpu", 0)], observed)


def work(kind: str, seed: int, first: int, count: int, link: Connection) -> None:
    """Run some cases in a process of its own; each is announced before and told after."""
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        run = Fuzz(Path(name)).kinds[kind]
        for model in MODELS:  # what is imported for them is none of a file's doing
            load_model(model)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        for number in range(first, count):
            link.send(number)
            link.send(_outcome(run, random.Random(f"{kind} {seed} {number}")))
    link.send("end")


def _outcome(run: Callable[[random.Random], None], draw: random.Random) -> tuple[str, str]:
    start, told = time.monotonic(), ""
    try:
        run(draw)
        outcome = "ok"
    except UserError as error:
        outcome, told = "UserError", str(error)
        if "\n" in told or len(told) > LONGEST + 100:
            outcome = "other"
        if "allocate" in told or "MemoryError" in told:
            outcome = "memory"
    except MemoryError as error:
        outcome, told = "memory", repr(error)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome, told = "other", f"{type(error).__name__} at {where.name}: {str(error)[:200]}"
    return ("slow" if time.monotonic() - start > SLOW else outcome), told


def counts(kind: str, count: int, seed: int, limit: float) -> collections.Counter[str]:
    """How many cases ended how; the first of each kind of other exception is printed.

    Args:
        kind: of files.
        count: cases.
        seed: with a case's number, decides its file.
        limit: seconds after which a case is stopped.
    """
    found: collections.Counter[str] = collections.Counter()
    known: set[str] = set()
    number = 0
    while number < count:
        mine, others = multiprocessing.Pipe()
        process = multiprocessing.get_context("fork").Process(target=work, args=(kind, seed, number, count, others))
        process.start()
        others.close()
        while True:
            try:
                if not mine.poll(limit):
                    process.kill()
                    outcome, told = "slow", "stopped"
                else:
                    said = mine.recv()
                    if said == "end":
                        number = count
                        break
                    if isinstance(said, int):
                        number = said
                        continue
                    outcome, told = said
            except EOFError:
                outcome, told = "crash", f"exit code {process.exitcode}"
            found[outcome] += 1
            if outcome not in ("ok", "UserError") and (short := told[:60]) not in known:
                known.add(short)
                print(f"{kind} {number}: {outcome}: {told}")
            if outcome == "crash" or told == "stopped":
                number += 1
                break
        process.join()
    return found


def main() -> None:
    """Print the counts of one kind of files, or of all."""
    demonstrations = ("safetensors", "npz", "lerobot", "lerobot v2.1", "minari", "bvh")
    kinds = ("config.json", "concept", *demonstrations, *FOREIGN, "results.csv", "checkpoint", "yaml")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=("all", *kinds), default="all")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for kind in kinds if options.kind == "all" else (options.kind,):
        start = time.monotonic()
        found = counts(kind, options.count, options.seed, limit=60)
        told = ", ".join(f"{outcome} {number}" for outcome, number in sorted(found.items()))
        print(f"{kind}: {told}; {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
