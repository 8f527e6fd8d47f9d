"""Files that claim or hold more than an honest one, and what is no file: refused in one line, at once, with little memory."""

import io
import json
import os
import signal
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from ftl_lightning.cli.concepts import SampleOptions
from ftl_lightning.cli.demonstrations import generate
from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats import files
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.evaluator import Evaluator
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import INVERSION, InversionSettings
from ftl_lightning.methods.ftl_igm.pretraining import Codes, LossOptions, PretrainingModule
from ftl_lightning.services.files import MOST_HEADER, MOST_TENSORS, VARIABLE, check_writable_file, check_writable_folder
from ftl_lightning.training.data import InversionData, PretrainingData
from ftl_lightning.training.trainer import Trainer

from . import conftest
from .conftest import CONF, ROOT
from .test_mistakes import refusal

SECONDS, MEGABYTES = 30.0, 500
"""That a refusal stays below on any machine, and that reading or waiting for what is refused goes beyond."""
COMPOSE = "--compose=go to red object"
SAMPLE = ["sample", "--pretrained=agent", COMPOSE]
FIT = ["fit", f"--config={CONF / 'object_rearrangement.yaml'}", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
INVERT = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", "--trainer.enable_progress_bar=false"]
SHIPPED = ROOT / "pretrained" / "object_rearrangement"
HERE = f"--model.pretrained={SHIPPED}"
LONG = "x" * 300
Told = pytest.CaptureFixture[str]


def memory() -> int:
    """The most megabytes that this process had since it was last asked to forget."""
    status = Path("/proc/self/status").read_text()
    return int(next(row for row in status.splitlines() if row.startswith("VmHWM")).split()[1]) // 1024


@contextmanager
def bounded() -> Iterator[None]:
    """Within the block, no more than the seconds and megabytes of a refusal; what waits for ever is stopped.

    Seconds are the processor's: other tests run beside this one.
    """
    signal.alarm(300)
    Path("/proc/self/clear_refs").write_text("5")
    before, start = memory(), time.process_time()
    try:
        yield
    finally:
        signal.alarm(0)
    assert time.process_time() - start < SECONDS
    assert memory() - before < MEGABYTES


def refused(capsys: Told, arguments: list[str], *expected: str) -> None:
    """As for every mistake, within its bounds, and with nothing else on standard error."""
    with bounded():
        told = conftest.refused(capsys, arguments, *expected)
    (row,) = filter(None, told.splitlines())
    assert "expected" in row or "cannot be written" in row


def not_taken(take: Callable[[Any], object], value: object, *expected: str) -> None:
    """The same of a function or a class, such as one that reads a file."""
    with bounded(), refusal(*expected) as told:
        take(value)
    assert "expected" in str(told.value) or "cannot be written" in str(told.value)


# Whatever is no file, under every name that a file may have

READ: dict[str, list[str]] = {
    "concept": ["explain", "--pretrained=agent", "--concept=x"],
    "concept beside a composition": [*SAMPLE, "--concept=x"],
    "initial": [*SAMPLE, "--initial=x"],
    "demonstrations": [*INVERT, HERE, "--data.demonstrations=x"],
    "own demonstrations": ["fit", f"--config={CONF / 'own.yaml'}", "--data.demonstrations=x"],
    "checkpoint": [*FIT, "--ckpt_path=x"],
    "configuration": ["fit", "--config=x"],
    "configuration apart": ["fit", "--config", "x"],
    "settings": [*SAMPLE, "--settings=x"],
    "results": ["report", "--results=x", "--out=o"],
    "README": ["report", f"--results={ROOT / 'results' / 'tabletop.csv'}", "--out=o", "--readme=x"],
    "results of an ablation": ["ablate", "--config=conf/ablation/smoke.yaml", "--results=x"],
    "results of an inversion": [*INVERT, HERE, "--evaluation.results=x"],
    "consent": ["study", "mocap", "--consent=x"],
    "answers": ["study-report", "x"],
}
"""Command lines that read the file ``x``."""


def sparse() -> None:
    with Path("x").open("wb") as file:
        file.truncate(3 * 2**30)


MAKE: dict[str, Callable[[], None]] = {
    "device": lambda: Path("x").symlink_to("/dev/zero"),
    "pipe": lambda: os.mkfifo("x"),
    "sparse": sparse,
    "unreadable": lambda: Path("x").symlink_to("x"),
}


@pytest.mark.parametrize("what", MAKE)
@pytest.mark.parametrize("reader", READ)
def test_what_is_no_honest_file(reader: str, what: str, capsys: Told) -> None:
    MAKE[what]()
    refused(capsys, READ[reader], "x")


@pytest.mark.parametrize("what", ["device", "pipe", "sparse"])
@pytest.mark.parametrize(
    ("place", "arguments"),
    [
        *((f"model/{name}", ["sample", "--pretrained=model", COMPOSE]) for name in ("config.json", "model.safetensors")),
        ("model/config.json", ["invert", f"--config={CONF / 'agent.yaml'}", "--model.pretrained=model"]),
        ("model/config.json", ["concepts", "model"]),
        ("films/films.json", ["study", "mocap", "--films=films"]),
        ("key.json", ["study-report", "answers.json"]),
        ("results/comparison.csv", ["report", "--results=results", "--out=o"]),
        ("inner.yaml", ["fit", "--config=outer.yaml"]),
    ],
)
def test_what_is_no_honest_file_in_a_folder(place: str, arguments: list[str], what: str, capsys: Told) -> None:
    for name in ("model", "films", "results"):
        Path(name).mkdir()
    Path("model/config.json").write_text((ROOT / "pretrained/agent/config.json").read_text())
    Path("outer.yaml").write_text("defaults: [inner.yaml]")
    Path("answers.json").write_text("{}")
    MAKE[what]()
    if what == "device":
        Path(place).unlink(missing_ok=True)
    Path("x").rename(place)
    refused(capsys, arguments)


def test_the_search_for_a_concept_s_model_passes_by_what_is_no_file(capsys: Told) -> None:
    for place in ("logs/a", "logs/b", "logs/c"):
        Path(place).mkdir(parents=True)
    os.mkfifo("logs/a/config.json")
    Path("logs/b/config.json").symlink_to("/dev/zero")
    sparse()
    Path("x").rename("logs/c/config.json")
    with bounded():
        conftest.succeed("explain", f"--concept={ROOT / 'pretrained' / 'mocap' / 'arm_circle.safetensors'}")


# Files that claim more than they hold, or hold more than they say


def header(content: bytes, claimed: int | None = None, rest: int = 0) -> None:
    """A safetensors file ``x`` of a header."""
    with Path("x").open("wb") as file:
        file.write(struct.pack("<Q", len(content) if claimed is None else claimed) + content)
        file.truncate(8 + len(content) + rest)


def tensors(count: int, key: str = "data_offsets") -> bytes:
    return ("{" + ",".join(f'"{index}":{{"dtype":"F32","shape":[0],"{key}":[0,0]}}' for index in range(count)) + "}").encode()


HEADERS: dict[str, Callable[[], None]] = {
    "a million tensors": lambda: header(tensors(10**6)),
    "a million tensors, keys written in another way": lambda: header(tensors(10**6, r"data\u005foffsets")),
    "tensors that just fit into a header": lambda: header(tensors(MOST_HEADER // 60, r"data\u005foffsets")),
    "a header of a terabyte": lambda: header(b"{}", 2**40),
    "a header as long as the file": lambda: header(b"[" * 2**24, 2**30, 2**30),
    "a header of no JSON": lambda: header(b'{"a":[' + b"1," * (2**23 - 10)),
    "a header of nothing": lambda: header(b""),
    "a file of three bytes": lambda: Path("x").write_bytes(b"abc") and None,
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_that_is_none(name: str, capsys: Told) -> None:
    HEADERS[name]()
    not_taken(Demonstrations.load, "x", "x: expected a demonstrations file")
    refused(capsys, READ["concept"], "x: expected a concept file")


FORM = {"kind": "demonstrations", "format": files.VERSION, "domain": "agent", "concepts": ["", ""], "per_step": []}
STATES = {"states": torch.zeros(2, 3, 13), "lengths": torch.full((2,), 3), "observed/world": torch.zeros(2, 52)}
GIGABYTE = 2**30


def deflated(begin: bytes = b"", megabytes: int = 1024) -> bytes:
    """A beginning and so many megabytes of zeros; compressed is one of them, and then repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    first = packer.compress(begin) + packer.flush(zlib.Z_FULL_FLUSH)
    one = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + one * megabytes + packer.flush()


def images(held: int, shape: list[int]) -> None:
    """Demonstrations ``x`` with images that are said to be of a shape, and are of so many bytes."""
    ends = b"\x78\xda", struct.pack(">I", held % 65521 << 16 | 1)  # of zlib's format: the sum of zeros is known
    packed = zlib.compress(bytes(held)) if held < 2**20 else ends[0] + deflated(megabytes=held >> 20) + ends[1]
    content = STATES | {"observed/x": torch.frombuffer(bytearray(packed), dtype=torch.uint8)}
    told = {"ftl_lightning": json.dumps(FORM | {"compressed": {"observed/x": shape}})}
    safetensors.torch.save_file(content, "x", told)


@pytest.mark.parametrize(
    ("held", "shape", "expected"),
    [
        (2**20, [2, 2**18, 2**17], "observed/x': expected images of shape (2, ...)"),
        (GIGABYTE, [2, 2**15, 2**14], "observed/x': images: expected at most"),
        (GIGABYTE, [2, 3], "observed/x': expected"),
        (6, [10**6] * 9, "observed/x': expected images of shape (2, ...)"),
        *((6, shape, "observed/x[") for shape in ([2, 3, 10**12], [2, -3], [2, 2**63], [10**9] * 3)),
    ],
    ids=str,
)
def test_compressed_images_that_come_to_more(held: int, shape: list[int], expected: str) -> None:
    images(held, shape)
    not_taken(Demonstrations.load, "x", "x: key '", expected)


def test_verbs_refuse_demonstrations_that_come_to_more(capsys: Told) -> None:
    images(GIGABYTE, [2, 2**15, 2**14])
    refused(capsys, READ["initial"], "x: key 'observed/x'", "found 1073741824; save it without compression")
    header(b'{"a":[' + b"1," * (2**23 - 10))
    refused(capsys, READ["demonstrations"], "x: expected a demonstrations file")


@pytest.mark.parametrize("reader", ["initial", "own demonstrations"])
def test_an_archive_of_a_gigabyte_in_a_megabyte(reader: str, capsys: Told) -> None:
    begin = io.BytesIO()
    np.lib.format.write_array_header_1_0(begin, {"descr": "<f4", "fortran_order": False, "shape": (1, 2**18, 1024)})
    with zipfile.ZipFile("x.npz", "w") as file:
        file.writestr("states.npy", deflated(begin.getvalue()))
        member = file.getinfo("states.npy")  # what the list at the end of the file says of it is what counts
        member.compress_type, member.file_size = zipfile.ZIP_DEFLATED, len(begin.getvalue()) + GIGABYTE
    assert Path("x.npz").stat().st_size < 2 * 2**20
    refused(capsys, [one.replace("=x", "=x.npz") for one in READ[reader]], "x.npz", "without compression")


def test_an_archive_of_a_million_arrays() -> None:
    with zipfile.ZipFile("x.npz", "w") as file:
        file.writestr("0.npy", b"")
        file.filelist *= MOST_TENSORS + 1
    not_taken(Demonstrations.load, "x.npz", "x.npz", "at most 2000 arrays")


def test_who_has_larger_files_says_so(capsys: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse()
    refused(capsys, READ["concept"], f"set {VARIABLE} to more")
    monkeypatch.setenv(VARIABLE, str(2**40))
    refused(capsys, READ["concept"], "expected a concept file, found")
    monkeypatch.setenv(VARIABLE, "much")
    refused(capsys, READ["concept"], f"{VARIABLE}: expected a number of bytes, found 'much'")


# Numbers


INVERSION_OPTIONS = ("components", "omega", "samples", "restarts", "mode_samples", "modes", "knots", "initial_omega")
NUMBERS: list[tuple[Callable[..., object], Sequence[str]]] = [
    (partial(PretrainingData, "object_rearrangement"), ("batch_size", "horizon", "steps_per_epoch")),
    (partial(PretrainingData, "object_rearrangement"), ("samples_per_concept", "validation_per_concept")),
    (PretrainingModule, ("diffusion_steps", "guidance")),
    (Codes, ("knots", "size")),
    (LossOptions, ("timestep_power",)),
    (Evaluator, ("samples", "steps", "figures", "replan", "temperature")),
    (Trainer, ("num_nodes", "devices")),
    (partial(InversionData, "object_rearrangement"), ("steps", "demonstrations_per_concept")),
    (InversionSettings().changed, (*INVERSION_OPTIONS, "guidance_scale", "timestep_power", "adapter")),
    (Sampling, ("temperature",)),
    (partial(SampleOptions, "agent"), ("count", "steps", "replan")),
    (partial(generate, "driving"), ("count", "workers")),
]


@pytest.mark.parametrize(("make", "key"), [(make, key) for make, keys in NUMBERS for key in keys])
def test_a_number_that_no_machine_has_room_for(make: Callable[..., object], key: str) -> None:
    for value in (10**12, 10**30):
        not_taken(lambda value: make(**{key: value}), value, f"{INVERSION.get(key, key).rpartition('.')[2]}: expected")


@pytest.mark.parametrize(
    ("base", "key"),
    [(FIT, "data.horizon"), ([*INVERT, HERE], "model.budget.samples"), (SAMPLE, "temperature"), (["generate", "driving"], "count")],
)
def test_a_number_that_no_machine_has_room_for_is_refused_by_a_verb(base: list[str], key: str, capsys: Told) -> None:
    refused(capsys, [*base, f"--{key}={10**30}"], key.rpartition(".")[2])


# Names


@pytest.mark.parametrize(
    "arguments",
    [
        *([one.replace("=x", f"={LONG}") for one in arguments] for arguments in READ.values() if "x" not in arguments),
        ["fit", "--config", LONG],
        ["explain", f"--pretrained={LONG}", "--concept=c"],
        *([verb, LONG] for verb in ("concepts", "generate", "study-report")),
        [*INVERT, f"--model.pretrained={LONG}"],
        *([*SAMPLE, f"--out={name}"] for name in (LONG, "ü" * 200)),
        [*SAMPLE, f"--figure={LONG}.png"],
        [*SAMPLE, f"--animation={LONG}.gif", "--execute=true"],
        [*SAMPLE, f"--goal={LONG}"],
        *(["sample", "--pretrained=agent", f"--compose={LONG}{end}"] for end in ("", ".safetensors")),
        [*FIT, f"--model.output={LONG}"],
        [*INVERT, HERE, f"--model.output={'ü' * 200}"],
        *([*FIT, f"--trainer.logger.init_args.{key}={LONG}"] for key in ("name", "save_dir")),
        [*INVERT, HERE, f"--trainer.logger.init_args.version={LONG}"],
        ["report", f"--results={ROOT / 'results'}", f"--out={LONG}"],
        *(["study", "mocap", f"--{key}={LONG}"] for key in ("out", "films")),
        *([verb, "agent", f"--out={LONG}"] for verb in ("generate", "encode")),
        *([verb, "mocap", f"--root={LONG}"] for verb in ("generate", "prepare")),
    ],
    ids=lambda value: " ".join(value)[:60],
)
def test_a_name_of_three_hundred_letters(arguments: list[str], capsys: Told) -> None:
    refused(capsys, arguments)


PLACES = ["/proc/x/o", "/sys/o", "/dev/null/o", "/dev/full", "file/o", "a\0b"]


@pytest.mark.parametrize("place", PLACES, ids=ascii)
@pytest.mark.parametrize("expect", [check_writable_file, check_writable_folder])
def test_what_cannot_be_written(expect: Callable[[str], None], place: str) -> None:
    Path("file").write_text("a file")
    not_taken(expect, place, place)


@pytest.mark.parametrize(
    "arguments",
    [
        *([*INVERT, HERE, f"--{key}="] for key in ("evaluation.results", "model.output")),
        *([*FIT, f"--{key}="] for key in ("model.output", "trainer.logger.init_args.save_dir")),
        *([*SAMPLE, "--execute=true", f"--{key}="] for key in ("out", "figure", "animation")),
        ["generate", "driving", "--out="],
        ["report", f"--results={ROOT / 'results'}", "--out="],
        ["ablate", "--config=conf/ablation/smoke.yaml", "--results="],
        ["study", "mocap", "--out="],
        ["encode", "agent", "--out="],
    ],
    ids=lambda value: " ".join((value[0], value[-1])),
)
def test_what_cannot_be_written_is_refused_before_the_work(arguments: list[str], capsys: Told) -> None:
    Path("file").write_text("a file")
    for place in ("file/o",) if "save_dir" in arguments[-1] else PLACES:
        refused(capsys, [*arguments[:-1], arguments[-1] + place])


@pytest.mark.parametrize("name", [LONG, "ü" * 200], ids=["long", "long in bytes"])
def test_a_concept_of_a_long_name_has_a_short_file(name: str) -> None:
    drawn = load_domain("object_rearrangement").source(None).draw("circle right of square", 5, 0)
    replace(drawn, concepts=(name,) * 5).save("d.safetensors")
    assert main(["invert", "object_rearrangement", "d.safetensors", "--steps=1", "--form=paper"]) == 0
    (file,) = Path("concepts").iterdir()
    assert len(file.name.encode()) < 256
    assert Concept.load(file).origin.name == name
