"""Files of arrays and tables from other programs: right values, notes on what is assumed, and damaged files in one line."""

import io
import json
import pickle
import struct
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning import FewShot
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import LONGEST, Note, UserError
from ftl_lightning.services.files import FILES
from tests.conftest import ROOT, refused, succeed

STATES = np.random.default_rng(0).normal(size=(3, 6, 2))
TEXTS = ["up", "left", "dówn"]
ROWS = [
    {"demonstration": demo, "time": step, "concept": TEXTS[demo], "x": STATES[demo, step, 0], "y": STATES[demo, step, 1]}
    for demo in range(3)
    for step in range(6)
]


def write_h5(name: str, **arrays: Any) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(name, "w") as file:
        for key, array in arrays.items():
            file[key] = array


def write_mat(name: str, **arrays: Any) -> None:
    from scipy.io import savemat

    savemat(name, arrays, do_compression=True)


def table() -> Any:
    import pandas as pd

    return pd.DataFrame(ROWS).sample(frac=1, random_state=0)


def write_table(name: str) -> None:
    if name.endswith(".csv"):
        table().to_csv(name, index=False)
    else:
        pytest.importorskip("pyarrow")
        table().set_index("demonstration").astype({"concept": "category"}).to_parquet(name)


WRITERS: dict[str, Callable[[str], None]] = {
    "npz": lambda name: np.savez(name, states=STATES, concepts=np.array(TEXTS)),
    "npy": lambda name: np.save(name, np.asfortranarray(STATES)),
    "json": lambda name: Path(name).write_text(json.dumps({"states": STATES.tolist(), "concepts": TEXTS})) and None,
    "mat": lambda name: write_mat(name, states=STATES, concepts=np.array(TEXTS, dtype=object)),
    "h5": lambda name: write_h5(name, states=STATES, concepts=TEXTS),
    "pt": lambda name: torch.save({"states": torch.from_numpy(STATES).requires_grad_(), "concepts": TEXTS}, name),
    "csv": write_table,
    "parquet": write_table,
}


def load(name: str) -> tuple[Demonstrations, list[str]]:
    """Demonstrations, and the notes on them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = Demonstrations.load(name)
    assert all(issubclass(each.category, Note) for each in caught)
    return found, [str(each.message) for each in caught]


@pytest.mark.parametrize("suffix", WRITERS)
def test_each_format_is_read_with_its_values(suffix: str, capsys: pytest.CaptureFixture[str]) -> None:
    WRITERS[suffix](name := f"d.{suffix}")
    found, notes = load(name)
    assert torch.equal(found.states, torch.from_numpy(STATES).float())
    assert found.lengths.tolist() == [6, 6, 6]
    assert found.concepts == (("", "", "") if suffix == "npy" else tuple(TEXTS))
    assert not notes
    succeed("check", name)
    assert "note: " not in capsys.readouterr().err


def ragged_mat(name: str) -> None:
    cells = np.empty((1, 3), dtype=object)
    cells[0] = [*(STATES[row, : 4 + row] for row in range(3))]
    write_mat(name, states=cells, observed={"start": STATES[:, 0]})


@pytest.mark.parametrize("suffix", ["json", "pt", "mat", "npz"])
def test_demonstrations_of_different_lengths_are_padded_with_the_last_state(suffix: str) -> None:
    paths = [STATES[row, : 4 + row] for row in range(3)]
    start = {"start": STATES[:, 0].tolist()}
    name = f"d.{suffix}"
    if suffix == "json":
        Path(name).write_text(json.dumps({"states": [path.tolist() for path in paths], "observed": start}))
    elif suffix == "pt":
        torch.save({"states": [torch.from_numpy(path) for path in paths], "observed": start}, name)
    elif suffix == "mat":
        ragged_mat(name)
    else:
        Demonstrations.of(paths, observed={"start": torch.from_numpy(STATES[:, 0]).float()}).save(name)
    found, notes = load(name)
    assert not notes
    assert found.lengths.tolist() == [4, 5, 6]
    for row, path in enumerate(paths):
        assert np.allclose(found.states[row, : 4 + row], path)
        assert np.allclose(found.states[row, 4 + row :], path[-1])
    assert np.allclose(found.observed["start"], STATES[:, 0])


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        ([], "states: expected 1 to 20000 arrays"),
        ([[[1, 2]], [[1]]], r"states\[1\]: expected an array \(time, state\) with 2 columns, found the shape \(1, 1\)"),
        ([[1, 2]], r"states\[0\]: .* found the shape \(2,\)"),
        ([[["a"]]], r"states\[0\]: expected numbers"),
        ([[[1], [1, 2]]], r"states\[0\]: expected numbers"),
        ([np.zeros((10**6, 1)), *[np.zeros((1, 1))] * 10**4], "lengths: expected padding to the longest, 1000000, within"),
    ],
)
def test_other_lists_of_demonstrations_are_refused(states: Any, expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        Demonstrations.of(states)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("observed_goal", "an observed feature is named 'observed/goal'"),
        ("Observed/start", "an observed feature is named 'observed/start'"),
        ("concept", "the nearest known name is 'concepts'"),
        ("state_name", "the nearest known name is 'state_names'"),
        ("rewards", "known are states, lengths, "),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "json", "h5", "mat", "pt"])
def test_an_array_that_is_not_read_is_noted_with_the_nearest_name(
    name: str, expected: str, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays: dict[str, Any] = {"states": STATES, name: STATES[:, 0]}
    if suffix == "npz":
        np.savez("d.npz", **arrays)
    elif suffix == "json":
        Path("d.json").write_text(json.dumps({key: array.tolist() for key, array in arrays.items()}))
    elif suffix == "h5":
        write_h5("d.h5", **arrays)
    elif suffix == "mat":
        write_mat("d.mat", **arrays)
    else:
        torch.save({key: torch.from_numpy(array) for key, array in arrays.items()}, "d.pt")
    _, notes = load(f"d.{suffix}")
    assert len(notes) == 1
    assert notes[0].startswith(f"d.{suffix}: array {name!r} is not read; {expected}")
    if suffix == "npz":
        succeed("check", "d.npz")
        assert capsys.readouterr().err.count(f"note: d.npz: array {name!r} is not read; {expected}") == 1


def test_arrays_that_are_not_read_may_hold_anything_and_few_are_named() -> None:
    many = {f"info{index}": np.array([{}], dtype=object) for index in range(30)}
    np.savez("d.npz", states=STATES, **many)  # type: ignore[arg-type]
    assert [note.split(": ", 1)[1][:20] for note in load("d.npz")[1]][-1] == "25 more are not read"
    Path("d.json").write_text(json.dumps({"states": STATES.tolist(), "info": [[1], [1, 2]]}))
    assert load("d.json")[1][0].startswith("d.json: array 'info' is not read")
    write_mat("d.mat", states=STATES, info={"a": {"b": [1, "x"]}})
    assert load("d.mat")[1][0].startswith("d.mat: array 'info' is not read")


IMAGES = np.random.default_rng(0).integers(0, 256, (3, 3, 10, 12), dtype=np.uint8)


@pytest.mark.parametrize("per_step", [False, True])
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("kind", ["shares", "float", "int", "bytes"])
def test_images_are_read_as_bytes_with_channels_first(kind: str, last: bool, per_step: bool) -> None:
    images = np.repeat(IMAGES[:, None], 6, axis=1) if per_step else IMAGES
    given = np.moveaxis(images, -3, -1) if last else images
    given = {"shares": given / 255, "float": given.astype(np.float32), "int": given.astype(np.int64), "bytes": given}[kind]
    more = {"per_step": np.array(["photo"])} if per_step else {}
    np.savez("d.npz", states=STATES, **{"observed/photo": given}, **more)  # type: ignore[arg-type]
    found, notes = load("d.npz")
    assert torch.equal(found.observed["photo"], torch.from_numpy(images))
    assert len(notes) == (kind != "bytes" or last)
    assert not notes or "'observed/photo' is read as images: " in notes[0]
    assert last == ("channels from the last axis to the first" in "".join(notes))


def test_numbers_that_are_no_images_stay_numbers() -> None:
    for values in (np.full((3, 3, 10, 12), -0.5), np.full((3, 3, 10, 12), 300.0), np.ones((3, 2, 10, 12)), np.ones((3, 3, 4, 4))):
        np.savez("d.npz", states=STATES, **{"observed/grid": values})
        found, notes = load("d.npz")
        assert not notes
        assert torch.equal(found.observed["grid"], torch.from_numpy(values).float())


@pytest.mark.parametrize(
    ("text", "states", "notes"),
    [
        ("demo,t,x\nb,1,4\na,0,1\nb,0,3\na,1,2\n", [[[3], [4]], [[1], [2]]], []),
        ("time,x\n2024-01-02T00:00:01,2\n2024-01-02T00:00:00.5,1\n", [[[1], [2]]], ["no column 'demonstration'"]),
        (",demonstration,x\n0,0,1\n1,0,2\n", [[[1], [2]]], ["no column 'time'", "column 'Unnamed: 0' is not read"]),
        ("demonstration,time,x\n0,1,2\n,,\n0,0,1\n", [[[1], [2]]], ["1 empty rows are left out"]),
    ],
)
def test_tables_are_read_with_notes_on_what_is_assumed(text: str, states: Any, notes: list[str]) -> None:
    Path("d.csv").write_text(text)
    found, told = load("d.csv")
    assert found.states.tolist() == states
    assert len(told) == len(notes)
    assert all(part in line for part, line in zip(notes, told, strict=True))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("time,x\n0,1\n1,abc\n", "column 'x': expected numbers, found 'abc' in row 2"),
        ("demonstration,time,x\n0,0,1\n0,1,\n", "column 'x': expected finite numbers, found nan in row 2"),
        ("time,x\n0,inf\n", "column 'x': expected finite numbers, found inf in row 1"),
        ("demonstration,x\n0,1\n,2\n", "column 'demonstration': expected a value in each row, found none in row 2"),
        ("demonstration,time,x\n0,0,1\n0,,2\n", "column 'time': expected a value in each row, found none in row 2"),
        (
            "time,x\n0,1\n1,2\n0,3\n",
            "column 'time': expected another time in each row .*, found two rows of 0; is",
        ),
        ("demonstration,concept,x\n0,a,1\n0,b,2\n", "column 'concept': expected a single text for each .* found another in row 2"),
        ("time,x\nnoon,1\nlater,2\n", "expected a table"),
        ("0,0,0.5\n0,1,0.6\n", "line 1: expected names of columns, found the number .*; add a line of names"),
        ("demonstration,x,y\n0,1,2,3\n0,1,2,4\n", "line 2: expected 3 values between commas, .*found more"),
        ("demonstration,note\n0,a\n", "columns: expected columns of numbers"),
        ("demonstration,x\n", "rows: expected one for each time, found none"),
        (",".join(map(str, range(10_000))), "columns: expected at most 2000, found 10000"),
        ("demonstration,x\n" + "0,1\n" * 10**5 + "".join(f"{demo},1\n" for demo in range(1, 10**4)), "lengths: expected padding"),
    ],
)
@pytest.mark.filterwarnings("ignore::ftl_lightning.services.errors.Note")
def test_tables_with_faults_are_refused_with_their_place(text: str, expected: str) -> None:
    Path("d.csv").write_text(text)
    with pytest.raises(UserError, match=rf"^d\.csv: {expected}"):
        Demonstrations.load("d.csv")


class Opens:
    """An object that makes a file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return open, ("opened", "w")


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue()


def archive(**members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for name, content in members.items():
            new.writestr(f"{name}.npy", content)
    return file.getvalue()


def torch_bytes(content: Any, packed: bool = False) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    if not packed:
        return file.getvalue()
    smaller = io.BytesIO()
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(smaller, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    return smaller.getvalue()


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def cells(count: int, content: bytes, name: bytes = b"") -> bytes:
    """An element of MATLAB that states a number of cells."""
    shape = element(5, struct.pack("<ii", count, 1))
    return element(14, element(6, struct.pack("<II", 1, 0)) + shape + element(1, name) + content)


def nested(depth: int) -> bytes:
    """Cells in cells; the innermost is empty."""
    content = cells(0, b"")
    for _ in range(depth):
        content = cells(1, content)
    return content


SHAPE = element(5, struct.pack("<iii", 1, 1, 1))
MATLAB = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
LARGE = {"x": "x" * 10**6}
TEXT_BOMB = {"states": STATES.tolist(), "concepts": [*("x" * 10**6,), *["a"] * 3000]}
BAD: dict[str, tuple[str, Callable[[], bytes]]] = {
    "a header of a billion numbers": ("npy", lambda: header((10**9, 1, 1)) + bytes(80)),
    "numbers of no bytes": ("npy", lambda: header((10**9, 1, 1), "|V0")),
    "texts of no bytes": ("npz", lambda: archive(states=header((10**9,), "<U0"))),
    "a long header": ("npy", lambda: b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"(" * 10**6),
    "negative sizes": ("npy", lambda: header((-1, 6, 2)) + STATES.tobytes()),
    "objects": ("npy", lambda: header((1,), "|O") + pickle.dumps(Opens())),
    "many texts": (
        "npz",
        lambda: archive(states=header((3, 6, 2)) + STATES.tobytes(), concepts=header((10**7,), "<U1") + bytes(4 * 10**7)),
    ),
    "halves of characters": (
        "npz",
        lambda: archive(states=header((3, 6, 2)) + STATES.tobytes(), concepts=header((3,), "<U1") + b"\0\xdc\0\0" * 3),
    ),
    "deep lists": ("json", lambda: b"[" * 10**6),
    "a long text": ("json", lambda: json.dumps(TEXT_BOMB).encode()),
    "a long text as a feature": ("json", lambda: json.dumps({"states": [[[1]]], "observed/x": TEXT_BOMB["concepts"]}).encode()),
    "missing numbers": ("json", lambda: b'{"states": [[[1, null]]]}'),
    "large numbers": ("json", lambda: b'{"states": [[[1' + b"0" * 400 + b"]]]}"),
    "other lengths": ("json", lambda: b'{"states": [[[1]], [[1], [2]]], "lengths": [2, 2]}'),
    "no states": ("json", lambda: b'{"state": [[[1]]]}'),
    "cells in cells": ("mat", lambda: MATLAB + cells(1, nested(2000), b"states")),
    "a billion cells": ("mat", lambda: MATLAB + cells(1, cells(2**31 - 1, b""), b"states")),
    "a billion numbers": ("mat", lambda: MATLAB + cells(10**9, b"", b"states")),
    "elements of unknown types": (
        "mat",
        lambda: MATLAB + element(14, struct.pack("<IIII", 6, 8, 6, 0) + SHAPE + element(1, b"states") + element(999, bytes(8))),
    ),
    "MATLAB 7.3": ("mat", lambda: b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384)),
    "an object": ("pt", lambda: torch_bytes({"states": torch.zeros(3, 6, 2), "x": Opens()})),
    "a packed archive": ("pt", lambda: torch_bytes({"states": torch.zeros(100, 1000, 100)}, packed=True)),
    "a number that is expanded": ("pt", lambda: torch_bytes({"states": torch.zeros(1).expand(10**5, 10**3, 100)})),
    "complex numbers": ("pt", lambda: torch_bytes({"states": torch.zeros(3, 6, 2, dtype=torch.complex64)})),
}
for suffix in FILES:
    if suffix != ".safetensors":
        BAD[f"nothing as {suffix}"] = (suffix[1:], lambda: b"")
        BAD[f"a text as {suffix}"] = (suffix[1:], lambda: b"hello world\n")
        BAD[f"random bytes as {suffix}"] = (suffix[1:], lambda: np.random.default_rng(0).bytes(5000))
        BAD[f"a pickle as {suffix}"] = (suffix[1:], lambda: pickle.dumps(Opens()))


def expect_refused(name: str) -> str:
    """One line that names the file, soon, and without much memory."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Note)
        with suppress(UserError):  # imports packages, whose time and memory are not the file's
            Demonstrations.load(name)
        tracemalloc.start()
        start = time.process_time()
        with pytest.raises(UserError) as caught:
            Demonstrations.load(name)
        taken, memory = time.process_time() - start, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert taken < 5  # twice as long as without the trace of memory
    assert memory < 500 * 2**20
    text = str(caught.value)
    assert text.startswith(f"{name}: ")
    assert "\n" not in text
    assert len(text) <= LONGEST
    assert not Path("opened").exists()
    return text


@pytest.mark.parametrize("fault", BAD)
def test_damaged_and_foreign_files_are_refused_in_a_line(fault: str) -> None:
    suffix, content = BAD[fault]
    if suffix in ("h5", "hdf5"):
        pytest.importorskip("h5py")
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    Path(f"d.{suffix}").write_bytes(content())
    expect_refused(f"d.{suffix}")


@pytest.mark.parametrize("suffix", WRITERS)
def test_half_a_file_is_refused(suffix: str) -> None:
    path = Path(f"d.{suffix}")
    WRITERS[suffix](path.name)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2 if suffix != "csv" else content.rindex(b",") + 1])
    expect_refused(path.name)


def test_links_claims_and_repeated_texts_of_hdf5_are_refused() -> None:
    h5py = pytest.importorskip("h5py")
    import zlib

    for fault in ("external", "claims", "chunk", "texts", "matlab", "lists", "empty"):
        with h5py.File("d.h5", "w") as file:
            if fault == "external":
                file["states"] = h5py.ExternalLink("other.h5", "/states")
            elif fault == "claims":
                file.create_dataset("states", shape=(10**9, 1, 1), chunks=(1000, 1, 1))
            elif fault == "chunk":
                file.create_dataset("states", shape=(1, 1, 1), maxshape=(None, 1, 1), chunks=(2**27, 1, 1), dtype="f8")
            elif fault == "empty":
                file["states"] = h5py.Empty("f8")
            else:
                file["states"] = STATES
            if fault == "texts":  # a text that is stored once
                kind = h5py.string_dtype()
                stored = file.create_dataset("concepts", (10**5,), kind, chunks=(10**5,), compression="gzip")
                stored[0] = "x" * 50_000
                reference = zlib.decompress(stored.id.read_direct_chunk((0,))[1])[:16]
                stored.id.write_direct_chunk((0,), zlib.compress(reference * 10**5))
            elif fault == "matlab":
                file["states"].attrs["MATLAB_class"] = np.bytes_("double")
            elif fault == "lists":
                file.create_dataset("concepts", (3,), dtype=h5py.vlen_dtype(np.int32))
        expect_refused("d.h5")


def test_repeated_texts_and_other_columns_of_parquet() -> None:
    pa = pytest.importorskip("pyarrow")
    from pyarrow.parquet import write_table

    text = "x" * 900_000
    numbers = list(range(1000))
    repeated = pa.DictionaryArray.from_arrays([0] * 1000, [text])
    write_table(pa.table({"demonstration": numbers, "concept": repeated, "x": numbers}), "d.parquet", store_schema=False)
    assert Path("d.parquet").stat().st_size < 10**6
    assert "characters" in expect_refused("d.parquet")
    write_table(pa.table({"note": repeated, "list": [[1]] * 1000, "x": numbers}), "d.parquet", store_schema=False)
    found, notes = load("d.parquet")
    assert found.states.shape == (1, 1000, 1)
    assert sum("is not read, as it holds no numbers" in note for note in notes) == 2
    write_table(pa.table({"x": pa.array(np.zeros(2 * 10**7, np.int8))}), "d.parquet", compression="zstd")
    assert "columns: expected at most" in expect_refused("d.parquet")
    write_table(pa.table([[1], [2]], names=["x", "x"]), "d.parquet")
    assert "columns of different names" in expect_refused("d.parquet")
    write_table(pa.table({"x": ["1.0"]}), "d.parquet")
    assert "expected columns of numbers" in expect_refused("d.parquet")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"states": [[[1, 2], [3, None]], [[1, 2], [3, 4]]]}, r"key 'states': .* in demonstration 1 at time 1, column 1"),
        ([[[1, 2], [3, 4]], [[1, 2], [None, 4], [3, 4]]], r"key 'states': .* in demonstration 2 at time 1, column 0"),
        ([[[1, 2], [3, 4]], [[1, 2], None]], r"key 'states': .* in demonstration 2 at time 1;"),
        ([[[1, 2], [3, 4]], None], r"key 'states': .* in demonstration 2;"),
        ({"states": None}, "key 'states': .* in demonstration 1;"),
        ({"states": [[[1], [2]]] * 2, "lengths": [2, None]}, r"key 'lengths': .* in index \[1\]"),
        ({"states": [[[1], [2]]] * 2, "observed": {"goal": [[1, 2], [None, 4]]}}, r"key 'observed/goal': .* in index \[1, 0\]"),
        (
            {"states": [[[1], [2]]] * 2, "observed": {"goal": [[[1], [2]], [[1], [None]]]}, "per_step": ["goal"]},
            r"key 'observed/goal': .* in demonstration 2 at time 1, column 0",
        ),
    ],
)
def test_a_missing_value_in_json_is_refused_with_its_place(content: Any, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("d.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=f"^d.json: {expected}") as refusal:
        Demonstrations.load("d.json")
    refused(capsys, ["check", "d.json"], str(refusal.value)[:60])


LARGE = np.arange(24).reshape(2, 6, 2) + 2**53


def test_whole_numbers_that_float64_cannot_hold_are_refused() -> None:
    np.savez("d.npz", states=LARGE)
    np.savez("observed.npz", states=STATES[:2], **{"observed/time": LARGE[:, 0]})  # type: ignore[arg-type]
    Path("d.json").write_text(json.dumps(LARGE.tolist()))
    Path("d.csv").write_text(f"demonstration,time,x\n0,0,{2**53 + 1}\n0,1,{2**53 + 3}\n")
    torch.save([torch.from_numpy(LARGE[0]), torch.from_numpy(LARGE[1, :3])], "d.pt")
    for name in ("d.npz", "observed.npz", "d.json", "d.csv", "d.pt"):
        with pytest.raises(UserError, match=r"expected whole numbers of at most 2\^53, found 90071992547\d+; subtract an offset"):
            Demonstrations.load(name)
    for states in (list(LARGE), [torch.from_numpy(path) for path in LARGE], LARGE.astype(np.uint64)):
        with pytest.raises(UserError, match=r"expected whole numbers of at most 2\^53"):
            Demonstrations.of(states)
    with pytest.raises(UserError, match=r"states: expected whole numbers of at most 2\^53"):
        FewShot.from_pretrained(ROOT / "pretrained" / "strokes").demonstrations(LARGE)


def test_whole_numbers_up_to_this_are_exact_and_padding_may_be_any() -> None:
    exact = LARGE - 30
    np.savez("d.npz", states=exact)
    assert Demonstrations.load("d.npz").states.long().tolist() == exact.tolist()
    padded = exact.copy()
    padded[:, 4:] = -(2**63)
    np.savez("d.npz", states=padded, lengths=[4, 4])
    assert Demonstrations.load("d.npz").states[:, :4].long().tolist() == exact[:, :4].tolist()


@pytest.mark.parametrize(
    "kind", [">f8", ">f4", ">i4", "f2", np.longdouble, "<i2", "u2", "object", "fortran", "read-only", "reversed"]
)
def test_arrays_of_any_kind_of_number_and_order_are_read(kind: Any) -> None:
    whole = np.round(STATES * 100)
    if kind == "object":
        given = np.empty(3, dtype=object)
        given[:] = list(whole)
    elif kind == "fortran":
        given = np.asfortranarray(whole)
    elif kind == "read-only":
        given = whole.copy()
        given.flags.writeable = False
    elif kind == "reversed":
        given = whole[:, ::-1].copy()[:, ::-1]
    else:
        given = whole.astype(kind) if kind != "u2" else np.abs(whole).astype(kind)
        whole = np.abs(whole) if kind == "u2" else whole
    model = FewShot.from_pretrained(ROOT / "pretrained" / "strokes")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(model.demonstrations(given).states, whole)
        assert np.array_equal(Demonstrations.of(given).states, whole)
        if kind != "object":
            np.savez("d.npz", states=given, **{"observed/start": given[:, 0]})  # type: ignore[arg-type]
            found = Demonstrations.load("d.npz")
            assert np.array_equal(found.states, whole)
            assert np.array_equal(found.observed["start"], whole[:, 0])


@pytest.mark.parametrize("kind", [complex, np.complex64, "datetime64[s]", "timedelta64[ms]", str, "S", "object"])
def test_arrays_of_other_than_numbers_are_refused(kind: Any, capsys: pytest.CaptureFixture[str]) -> None:
    given = (STATES * 100).astype(np.int64).astype(kind)
    model = FewShot.from_pretrained(ROOT / "pretrained" / "strokes")
    with pytest.raises(UserError, match="states: expected an array of numbers, found"):
        model.demonstrations(given)
    with pytest.raises(UserError, match=r"states\[0\]: expected numbers \(time, state\), found"):
        Demonstrations.of(given)
    np.savez("d.npz", states=given)
    refused(capsys, ["check", "d.npz"], "d.npz: ", "expected an")
    np.savez("d.npz", states=STATES, **{"observed/start": given[:, 0]})  # type: ignore[arg-type]
    refused(capsys, ["check", "d.npz"], "d.npz: ", "expected an")


def test_lengths_of_whole_numbers_of_any_type_are_read_and_others_refused() -> None:
    for lengths in (np.array([6.0, 5, 4]), np.array([6, 5, 4], ">i4"), np.array([6, 5, 4], "u1")):
        np.savez("d.npz", states=STATES, lengths=lengths)
        assert Demonstrations.load("d.npz").lengths.tolist() == [6, 5, 4]
    for lengths in (np.array([6.5, 5, 4]), np.array([True] * 3), np.array(["6"] * 3), np.array([6, 5, np.nan])):
        np.savez("d.npz", states=STATES, lengths=lengths)
        with pytest.raises(UserError, match="key 'lengths': expected"):
            Demonstrations.load("d.npz")


@pytest.mark.parametrize(
    "key", ["observed_names", "observed/start_units", "observed_units/start", "observed/start/names", "obs_names"]
)
@pytest.mark.parametrize("suffix", ["npz", "json"])
def test_names_and_units_of_observed_features_are_refused(key: str, suffix: str, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = {"states": STATES, "observed/start": STATES[:, 0], key: np.array(["x", "y"])}
    if suffix == "npz":
        np.savez("d.npz", **arrays)  # type: ignore[arg-type]
    else:
        Path("d.json").write_text(json.dumps({name: array.tolist() for name, array in arrays.items()}))
    refused(capsys, ["check", f"d.{suffix}"], f"d.{suffix}: key '{key}': expected no names and units of observed features, found")
