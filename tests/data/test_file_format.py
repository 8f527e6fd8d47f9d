from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats.file_format import VERSION
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.tensor_file import file_hash, save_tensors
from tests.data.samples import demonstrations

shapes = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 6))


@settings(max_examples=10, deadline=None)
@given(shape=shapes, seed=st.integers(0, 2**31), initial=st.booleans(), text=st.text(max_size=20))
def test_round_trip_through_a_file_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], seed: int, initial: bool, text: str
) -> None:
    draw = torch.Generator().manual_seed(seed)
    states = torch.randn(shape, generator=draw) * 1e3
    photos = torch.randint(256, (shape[0], 3, 2, 2), generator=draw, dtype=torch.uint8)
    before = demonstrations(
        states,
        concepts=(text,) * shape[0],
        observed={"place": torch.randn((*shape[:2], 3), generator=draw), "photo": photos} if initial else {},
        per_step=("place",) if initial else (),
        scenes=torch.randn((shape[0], 4), generator=draw) if initial else None,
        provenance={"seed": seed, "nested": {"a": [1, None]}},
    )
    path = tmp_path_factory.mktemp("demos") / "d.safetensors"
    before.save(path)
    after = Demonstrations.load(path)
    assert torch.equal(after.states, before.states)
    assert torch.equal(after.lengths, before.lengths)
    assert after.observed.keys() == before.observed.keys()
    for name, values in before.observed.items():
        assert torch.equal(after.observed[name], values)
        assert after.observed[name].dtype == values.dtype
    assert (after.per_step, after.features) == (before.per_step, before.features)
    assert (after.scenes is None) == (not initial)
    assert after.scenes is None or torch.equal(after.scenes, before.scenes)  # type: ignore[arg-type]
    assert (after.concepts, after.provenance, after.hash) == (before.concepts, before.provenance, before.hash)
    first = file_hash(path)
    after.save(path)
    assert file_hash(path) == first  # the same content gives the same bytes


def test_damaged_and_foreign_files_are_told_apart_and_an_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    with pytest.raises(UserError, match="found nothing"):
        Demonstrations.load(path)
    demonstrations(torch.zeros(2, 1, 3)).save(path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(UserError, match="damaged or foreign"):
        Demonstrations.load(path)
    with pytest.raises(UserError, match=r"d\.safetensors/e\.safetensors: cannot be written"):
        demonstrations(torch.zeros(1, 1, 1)).save(path / "e.safetensors")


def test_what_is_observed_may_be_the_scene_itself(tmp_path: Path) -> None:
    same = torch.arange(6.0).reshape(2, 3)
    demonstrations(torch.zeros(2, 1, 1), observed={"world": same}, scenes=same).save(tmp_path / "d.safetensors")
    found = Demonstrations.load(tmp_path / "d.safetensors")
    assert found.scenes is not None
    assert torch.equal(found.scenes, found.observed["world"])
    assert torch.equal(found.scenes, same)


@pytest.mark.parametrize("version", [1, VERSION - 1, VERSION + 1, True, "4"])
def test_a_file_of_another_version_is_refused(version: Any) -> None:
    save_tensors("d.safetensors", "demonstrations", {"states": torch.zeros(2, 4, 1)}, {}, version)
    with pytest.raises(UserError, match=rf"^d\.safetensors: key 'format': expected {VERSION}, found .*; it is of another version$"):
        Demonstrations.load("d.safetensors")
