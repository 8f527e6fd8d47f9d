from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import atomic, file_hash


def demonstrations(states: torch.Tensor, **changes: object) -> Demonstrations:
    count, time, columns = states.shape
    values = {
        "states": states,
        "lengths": torch.full((count,), time),
        "domain": "object_rearrangement",
        "state_names": tuple(f"s{i}" for i in range(columns)),
        "state_units": ("m",) * columns,
        "concepts": tuple(f"task {i % 2}" for i in range(count)),
    }
    return Demonstrations(**(values | changes))  # type: ignore[arg-type]


shapes = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 6))


@settings(max_examples=30, deadline=None)
@given(shape=shapes, seed=st.integers(0, 2**31), initial=st.booleans(), text=st.text(max_size=20))
def test_round_trip_through_a_file_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], seed: int, initial: bool, text: str
) -> None:
    draw = torch.Generator().manual_seed(seed)
    states = torch.randn(shape, generator=draw) * 1e3
    before = demonstrations(
        states,
        concepts=(text,) * shape[0],
        initial_states=torch.randn((shape[0], 3), generator=draw) if initial else None,
        provenance={"seed": seed, "nested": {"a": [1, None]}},
    )
    path = tmp_path_factory.mktemp("demos") / "d.safetensors"
    before.save(path)
    after = Demonstrations.load(path)
    assert torch.equal(after.states, before.states)
    assert torch.equal(after.lengths, before.lengths)
    assert (after.initial_states is None) == (not initial)
    assert (after.concepts, after.provenance, after.hash) == (before.concepts, before.provenance, before.hash)
    first = file_hash(path)
    after.save(path)
    assert file_hash(path) == first  # the same content gives the same bytes


def test_npz_is_accepted_without_objects(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", states=np.ones((2, 1, 21)), concepts=np.array(["a", "b"]))
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.states.shape == (2, 1, 21)
    assert loaded.states.dtype == torch.float32
    assert loaded.concepts == ("a", "b")
    np.savez(tmp_path / "o.npz", states=np.array([{}], dtype=object))
    with pytest.raises(UserError, match=r"o\.npz: expected an \.npz of plain arrays"):
        Demonstrations.load(tmp_path / "o.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": torch.zeros(0, 1, 2)}, "at least one demonstration, found none"),
        ({"states": torch.full((1, 1, 2), float("nan"))}, r"key 'states': expected finite numbers, found nan at index \[0, 0, 0\]"),
        ({"states": torch.zeros(1, 2)}, r"expected float32 of shape \(demo, time, state\)"),
        ({"lengths": torch.tensor([3])}, "key 'lengths': expected 1 values between 1 and 1"),
        ({"concepts": ("a", "b")}, "key 'concepts': expected 1 entries, found 2"),
        ({"initial_states": torch.zeros(2, 3)}, "key 'initial_states'"),
    ],
)
def test_content_is_checked(changes: dict[str, object], message: str) -> None:
    states = changes.get("states", torch.zeros(1, 1, 2))
    base = {"state_names": ("a", "b"), "state_units": ("", ""), "lengths": torch.ones(1, dtype=torch.int64), "concepts": ("a",)}
    with pytest.raises(UserError, match=message):
        Demonstrations(**({"states": states, "domain": ""} | base | changes))  # type: ignore[arg-type]


def test_damaged_and_foreign_files_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    with pytest.raises(UserError, match="found nothing"):
        Demonstrations.load(path)
    demonstrations(torch.zeros(2, 1, 3)).save(path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(UserError, match="damaged or foreign"):
        Demonstrations.load(path)


def test_selection_naming_and_concatenation() -> None:
    both = demonstrations(torch.arange(8.0).reshape(4, 1, 2))
    one, other = both.select("task 0"), both.select("task 1")
    assert torch.equal(one.states, both.states[[0, 2]])
    joined = concatenate([one, other])
    assert joined.concepts == ("task 0", "task 0", "task 1", "task 1")
    assert demonstrations(torch.zeros(2, 1, 1), concepts=("", "x")).named("mine").concepts == ("mine", "x")


def test_nothing_half_written_is_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def interrupted() -> None:
        with atomic(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.txt"]


def test_a_full_disk_is_a_clear_error() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full, which this system lacks")
    with pytest.raises(UserError, match="No space left on device"), atomic("file.txt"):
        Path("/dev/full").write_text("x")


def test_an_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/d\.safetensors: cannot be written"):
        demonstrations(torch.zeros(1, 1, 1)).save(tmp_path / "file" / "d.safetensors")


def test_windows_are_padded_with_the_last_state() -> None:
    states = torch.arange(10.0).reshape(2, 5, 1)
    whole = Demonstrations(states, torch.tensor([5, 3]), "", ("x",), ("m",), ("a", "b"), initial_states=states + 100)
    assert whole.starts(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 0.9999, 0.5, 0.9]), 3.0).tolist() == [0, 4, 0, 2]
    found, initial = whole.windows(torch.tensor([0, 1]), torch.tensor([3, 0]), 4)
    assert found[..., 0].tolist() == [[3, 4, 4, 4], [5, 6, 7, 8]]
    assert initial is not None
    assert initial[:, 0].tolist() == [103, 105]


def test_windows_start_at_the_beginning_where_only_the_first_initial_state_is_known() -> None:
    whole = Demonstrations(torch.zeros(2, 5, 1), torch.tensor([5, 3]), "", ("x",), ("m",), ("a", "b"), torch.eye(2))
    assert whole.starts(torch.tensor([0, 1]), torch.tensor([0.1, 0.9]), 3.0).tolist() == [0, 0]
    assert torch.equal(whole.windows(torch.tensor([1]), torch.tensor([0]), 2)[1], torch.eye(2)[1:])


def test_initial_states_of_another_number_of_times_are_refused() -> None:
    with pytest.raises(UserError, match=r"key 'initial_states': expected shape \(2, initial state\) or \(2, 5, initial state\)"):
        Demonstrations(torch.zeros(2, 5, 1), torch.tensor([5, 3]), "", ("x",), ("m",), ("a", "b"), torch.zeros(2, 4, 3))
