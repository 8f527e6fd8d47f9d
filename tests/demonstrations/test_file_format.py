from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import Feature
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import file_hash, save_tensors, serialise
from tests.demonstrations.samples import demonstrations

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


def header(found: Demonstrations) -> dict[str, object]:
    """What every form of file says of demonstrations."""
    return {name: getattr(found, name) for name in ("domain", "state_names", "state_units", "concepts")}


def test_files_without_images_keep_their_form_and_their_bytes(tmp_path: Path) -> None:
    path, plain = tmp_path / "d.safetensors", demonstrations(torch.ones(2, 3, 1), observed={"place": torch.ones(2, 3)})
    plain.save(path)
    assert path.read_bytes() == serialise("demonstrations", plain.tensors, header(plain) | {"per_step": (), "provenance": {}}, 2)


FIRST = {"domain": "driving", "state_names": ["x"], "state_units": ["m"], "concepts": ["a", "b"], "provenance": {"seed": 1}}


def first_form(path: Path, initial: torch.Tensor | None, time: int = 4) -> Demonstrations:
    """What loads of a file of form 1, as it was written before features had names."""
    tensors = {"states": torch.zeros(2, time, 1), "lengths": torch.tensor([time, 2])}
    save_tensors(path, "demonstrations", tensors | ({} if initial is None else {"initial_states": initial}), FIRST, 1)
    return Demonstrations.load(path)


def test_files_of_the_first_form_still_load(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    plain = first_form(path, None)
    assert (plain.observed, plain.scenes, plain.per_step) == ({}, None, ())
    assert plain.provenance == {"seed": 1}
    always = torch.arange(2 * 4 * 5.0).reshape(2, 4, 5)
    found = first_form(path, always)
    assert found.per_step == ("initial_state",)
    assert torch.equal(found.observed["initial_state"], always)
    assert torch.equal(found.initial_states.require_scenes(), always[:, 0])
    once = first_form(path, always[:, 0])
    assert once.per_step == ()
    assert torch.equal(once.initial_states.require_scenes(), always[:, 0])


def test_columns_of_the_first_form_become_the_domains_features(tmp_path: Path) -> None:
    always = torch.arange(2 * 4 * 7.0).reshape(2, 4, 7)
    features = {"pose": Feature((2,)), "grid": Feature((2, 2))}
    found = first_form(tmp_path / "d.safetensors", always).fitted(features)
    assert found.per_step == ("pose", "grid")
    assert torch.equal(found.observed["pose"], always[..., :2])
    assert torch.equal(found.observed["grid"], always[..., 2:6].reshape(2, 4, 2, 2))
    assert torch.equal(found.initial_states.require_scenes(), always[:, 0])  # the column that no model sees is part of it
    once = first_form(tmp_path / "d.safetensors", always[:, 0]).fitted(features)
    assert once.per_step == ()
    assert torch.equal(once.observed["grid"], always[:, 0, 2:6].reshape(2, 2, 2))
    whole = first_form(tmp_path / "d.safetensors", always).fitted({})
    assert set(whole.observed) == {"initial_state"}  # a domain that observes nothing takes nothing
    with pytest.raises(UserError, match="key 'initial_states': expected 8 numbers each or more, found 7"):
        first_form(tmp_path / "d.safetensors", always).fitted(features | {"more": Feature((2,))})


def test_drivings_columns_of_the_first_form_are_traffic_scenario_and_a_seed_that_no_model_sees(tmp_path: Path) -> None:
    domain = load_domain("driving")
    drives = domain.source(None).split("train", 2, 0).select("merge")
    scenes = drives.initial_states.require_scenes()
    seeds = scenes[:, None, -1:].expand(-1, drives.states.shape[1], -1)
    old = torch.cat((*(drives.observed[name] for name in domain.observed), seeds), dim=-1)
    assert old.shape[2] == 37
    tensors = {"states": drives.states, "lengths": drives.lengths, "initial_states": old}
    save_tensors(tmp_path / "old.safetensors", "demonstrations", tensors, header(drives) | {"provenance": {}}, 1)
    found = Demonstrations.load(tmp_path / "old.safetensors").fitted(domain.observed)
    assert found.per_step == drives.per_step
    for name, values in drives.observed.items():
        assert torch.equal(found.observed[name], values)
    assert torch.equal(found.initial_states.require_scenes(), scenes)
    assert found.hash == drives.hash
