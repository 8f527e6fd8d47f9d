"""Files that claim or hold more than an honest one, and what is no file: refused in one line, at once, with little memory."""

import json
import os
import signal
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from ftl_lightning.cli import main
from ftl_lightning.limits import MOST_HEADER, VARIABLE

from . import conftest
from .conftest import CONF, ROOT

SECONDS, MEGABYTES = 2.0, 500
"""That a refusal may take, above what the program has itself."""
COMPOSE = "--compose=go to red object"
SAMPLE = ["sample", "--pretrained=agent", COMPOSE]
FIT = ["fit", f"--config={CONF / 'object_rearrangement.yaml'}", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
INVERT = ["invert", f"--config={CONF / 'object_rearrangement.yaml'}", "--trainer.enable_progress_bar=false"]
HERE = f"--model.pretrained={ROOT / 'pretrained' / 'object_rearrangement'}"
LONG = "x" * 300
Told = pytest.CaptureFixture[str]


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    """What the program itself takes, once: the verbs' modules."""
    main(["explain", "--concept=nothing.safetensors"])
    main([*SAMPLE, "--steps=0", "--count=0"])
    main([*FIT, "--data.batch_size=0"])
    main([*INVERT, "--data.steps=0", HERE])
    main(["report", "--results=nothing"])
    main(["study", "mocap", "--films=nothing"])


def memory() -> int:
    """The most megabytes that this process had since it was last asked to forget."""
    status = Path("/proc/self/status").read_text()
    return int(next(row for row in status.splitlines() if row.startswith("VmHWM")).split()[1]) // 1024


@contextmanager
def bounded() -> Iterator[None]:
    """Within the block, no more than the seconds and megabytes of a refusal; what waits for ever is stopped.

    Seconds are the processor's: other tests run beside this one.
    """
    signal.alarm(60)
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


def device() -> None:
    Path("x").symlink_to("/dev/zero")


def pipe() -> None:
    os.mkfifo("x")


def sparse(size: int = 3 * 2**30) -> None:
    with Path("x").open("wb") as file:
        file.truncate(size)


def unreadable() -> None:
    Path("x").symlink_to("x")


@pytest.mark.parametrize("make", [device, pipe, sparse, unreadable], ids=lambda make: make.__name__)
@pytest.mark.parametrize("reader", READ)
def test_what_is_no_honest_file(reader: str, make: Callable[[], None], capsys: Told) -> None:
    make()
    refused(capsys, READ[reader], "x")


@pytest.mark.parametrize("make", [device, pipe, sparse], ids=lambda make: make.__name__)
@pytest.mark.parametrize(
    ("place", "arguments"),
    [
        ("model/config.json", ["sample", "--pretrained=model", COMPOSE]),
        ("model/model.safetensors", ["sample", "--pretrained=model", COMPOSE]),
        ("model/config.json", ["invert", f"--config={CONF / 'agent.yaml'}", "--model.pretrained=model"]),
        ("model/config.json", ["concepts", "model"]),
        ("films/films.json", ["study", "mocap", "--films=films"]),
        ("key.json", ["study-report", "answers.json"]),
        ("results/comparison.csv", ["report", "--results=results", "--out=o"]),
        ("inner.yaml", ["fit", "--config=outer.yaml"]),
    ],
)
def test_what_is_no_honest_file_in_a_folder(place: str, arguments: list[str], make: Callable[[], None], capsys: Told) -> None:
    for name in ("model", "films", "results"):
        Path(name).mkdir()
    Path("model/config.json").write_text((ROOT / "pretrained/agent/config.json").read_text())
    Path("outer.yaml").write_text("defaults: [inner.yaml]")
    Path("answers.json").write_text("{}")
    make()
    if make is device:
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
    shipped = ROOT / "pretrained" / "mocap" / "arm_circle.safetensors"
    with bounded():
        assert main(["explain", f"--concept={shipped}"]) == 0


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
@pytest.mark.parametrize("reader", ["concept", "initial", "demonstrations"])
def test_a_header_that_is_none(reader: str, name: str, capsys: Told) -> None:
    HEADERS[name]()
    refused(capsys, READ[reader], "x")


FORM = {"kind": "demonstrations", "format": 3, "domain": "agent", "concepts": ["", ""], "per_step": []}
STATES = {"states": torch.zeros(2, 3, 13), "lengths": torch.full((2,), 3), "observed/world": torch.zeros(2, 52)}


@pytest.mark.parametrize(
    ("held", "shape", "expected"),
    [
        (2**20, [2, 2**35], "expected images of shape (2, ...)"),
        (2**30, [2, 2**29], "found 1073741824; save it without compression"),
        (2**30, [2, 3], "expected"),
        (6, [2, 3, 10**12], "expected"),
        (6, [2, -3], "expected"),
        (6, [2, 2**63], "expected"),
        (6, [10**9, 10**9, 10**9], "expected"),
    ],
    ids=str,
)
def test_compressed_images_that_come_to_more(held: int, shape: list[int], expected: str, capsys: Told) -> None:
    compressor = zlib.compressobj(9)
    chunks = [compressor.compress(bytes(min(held, 2**20))) for _ in range(max(1, held >> 20))]
    packed = bytearray(b"".join(chunks) + compressor.flush())
    content = STATES | {"observed/x": torch.frombuffer(packed, dtype=torch.uint8)}
    told = {"ftl_lightning": json.dumps(FORM | {"compressed": {"observed/x": shape}})}
    safetensors.torch.save_file(content, "x", told)
    del content, packed
    refused(capsys, READ["initial"], "x: key 'observed/x'", expected)


@pytest.mark.parametrize("reader", ["initial", "demonstrations", "own demonstrations"])
def test_an_archive_of_a_gigabyte_in_a_megabyte(reader: str, capsys: Told) -> None:
    with zipfile.ZipFile("x.npz", "w", zipfile.ZIP_DEFLATED) as file, file.open("states.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f4", "fortran_order": False, "shape": (1, 2**18, 1000)})
        for _ in range(1000):
            member.write(bytes(2**20))
    refused(capsys, [one.replace("=x", "=x.npz") for one in READ[reader]], "x.npz", "without compression")


def test_an_archive_of_a_million_arrays(capsys: Told) -> None:
    with zipfile.ZipFile("x.npz", "w") as file:
        for index in range(21_000):
            file.writestr(f"{index}.npy", b"")
    refused(capsys, [*SAMPLE, "--initial=x.npz"], "x.npz", "21000 arrays")


def test_who_has_larger_files_says_so(capsys: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse()
    refused(capsys, READ["concept"], f"set {VARIABLE} to more")
    monkeypatch.setenv(VARIABLE, str(2**40))
    refused(capsys, READ["concept"], "expected a concept file, found")
    monkeypatch.setenv(VARIABLE, "much")
    refused(capsys, READ["concept"], f"{VARIABLE}: expected a number of bytes, found 'much'")


# Numbers


@pytest.mark.parametrize(
    ("base", "key"),
    [
        *(
            (FIT, f"data.{key}")
            for key in ("batch_size", "horizon", "samples_per_concept", "steps_per_epoch", "validation_per_concept")
        ),
        *((FIT, f"model.{key}") for key in ("diffusion_steps", "codes.knots", "codes.size", "loss.timestep_power", "guidance")),
        *((FIT, f"evaluation.{key}") for key in ("samples", "steps", "figures", "replan", "temperature")),
        *((FIT, f"trainer.{key}") for key in ("num_nodes", "devices")),
        *(([*INVERT, HERE], f"data.{key}") for key in ("steps", "demonstrations_per_concept")),
        *(
            ([*INVERT, HERE], f"model.{key}")
            for key in ("components", "budget.samples", "budget.restarts", "modes.samples", "modes.sets", "embeddings.knots")
        ),
        *(
            ([*INVERT, HERE], f"model.{key}")
            for key in ("omega", "weights.initial", "weights.scale", "loss.timestep_power", "adapter.rank")
        ),
        *((SAMPLE, key) for key in ("count", "steps", "replan", "temperature")),
        (["generate", "driving"], "count"),
        (["generate", "driving"], "workers"),
    ],
)
@pytest.mark.parametrize("value", ["1000000000000", "1000000000000000000000000000000"])
def test_a_number_that_no_machine_has_room_for(base: list[str], key: str, value: str, capsys: Told) -> None:
    refused(capsys, [*base, f"--{key}={value}"], key.rpartition(".")[2])


# Names


@pytest.mark.parametrize(
    "arguments",
    [
        *(
            [one.replace("=x", f"={LONG}") if "=x" in one else one for one in arguments]
            for arguments in READ.values()
            if "x" not in arguments
        ),
        ["fit", "--config", LONG],
        ["study-report", LONG],
        ["explain", f"--pretrained={LONG}", "--concept=c"],
        ["concepts", LONG],
        [*INVERT, f"--model.pretrained={LONG}"],
        [*SAMPLE, f"--out={LONG}"],
        [*SAMPLE, f"--out={'ü' * 200}"],
        [*SAMPLE, f"--figure={LONG}.png"],
        [*SAMPLE, f"--animation={LONG}.gif", "--execute=true"],
        [*SAMPLE, f"--goal={LONG}"],
        ["sample", "--pretrained=agent", f"--compose={LONG}"],
        ["sample", "--pretrained=agent", f"--compose={LONG}.safetensors"],
        [*FIT, f"--model.output={LONG}"],
        [*INVERT, HERE, f"--model.output={'ü' * 200}"],
        [*FIT, f"--trainer.logger.init_args.name={LONG}"],
        [*FIT, f"--trainer.logger.init_args.save_dir={LONG}"],
        [*INVERT, HERE, f"--trainer.logger.init_args.version={LONG}"],
        ["report", f"--results={ROOT / 'results'}", f"--out={LONG}"],
        ["study", "mocap", f"--out={LONG}"],
        ["study", "mocap", f"--films={LONG}"],
        ["generate", LONG],
        ["generate", "agent", f"--out={LONG}"],
        ["generate", "mocap", f"--root={LONG}"],
        ["prepare", "mocap", f"--root={LONG}"],
        ["encode", "agent", f"--out={LONG}"],
    ],
    ids=lambda value: " ".join(value)[:60],
)
def test_a_name_of_three_hundred_letters(arguments: list[str], capsys: Told) -> None:
    refused(capsys, arguments)


PLACES = ["/proc/x/o", "/sys/o", "/dev/null/o", "/dev/full", "file/o", "a\0b"]


@pytest.mark.parametrize("place", PLACES, ids=ascii)
@pytest.mark.parametrize(
    "arguments",
    [
        [*INVERT, HERE, "--evaluation.results="],
        [*INVERT, HERE, "--model.output="],
        [*FIT, "--model.output="],
        [*FIT, "--trainer.logger.init_args.save_dir="],
        [*SAMPLE, "--out="],
        ["generate", "driving", "--out="],
        ["report", f"--results={ROOT / 'results'}", "--out="],
        ["ablate", "--config=conf/ablation/smoke.yaml", "--results="],
        ["study", "mocap", "--out="],
        ["encode", "agent", "--out="],
    ],
    ids=lambda value: " ".join((value[0], value[-1])),
)
def test_what_cannot_be_written_is_refused_before_the_work(arguments: list[str], place: str, capsys: Told) -> None:
    Path("file").write_text("a file")
    refused(capsys, [*arguments[:-1], arguments[-1] + place])


@pytest.mark.parametrize("place", PLACES[:3], ids=ascii)
@pytest.mark.parametrize("key", ["figure", "animation"])
def test_a_picture_that_cannot_be_written_is_refused_before_the_work(key: str, place: str, capsys: Told) -> None:
    ending = {"figure": ".png", "animation": ".gif"}[key]
    refused(capsys, [*SAMPLE, "--execute=true", f"--{key}={place}{ending}"], key, "cannot be written")


@pytest.mark.parametrize("name", [LONG, "ü" * 200], ids=["long", "long in bytes"])
def test_a_concept_that_no_file_can_be_called_after_is_refused_before_learning(name: str, capsys: Told) -> None:
    from dataclasses import replace

    from ftl_lightning.domains.registry import load_domain

    drawn = load_domain("object_rearrangement").source(None).draw("circle right of square", 5, 0)
    replace(drawn, concepts=(name,) * 5).save("d.safetensors")
    refused(capsys, [*INVERT, HERE, "--data.demonstrations=d.safetensors", "--data.steps=1"], "concepts: ", "cannot be written")
