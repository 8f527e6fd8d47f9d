import json
import os
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ftl_lightning.demonstrations.container import Demonstrations, concatenate
from ftl_lightning.demonstrations.features import Feature
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import atomic, file_hash, save_tensors, serialise, write_text


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
        ({"observed": {"place": torch.zeros(2, 3)}}, r"key 'observed/place': expected shape \(1, ...\), found \(2, 3\)"),
        ({"observed": {"place": torch.zeros(1)}}, r"key 'observed/place': expected shape \(1, ...\), found \(1,\)"),
        (
            {"observed": {"place": torch.zeros(1, 3)}, "per_step": ("place",)},
            r"key 'observed/place': expected shape \(1, 1, ...\), found \(1, 3\)",
        ),
        ({"observed": {"place": torch.full((1, 3), float("inf"))}}, "key 'observed/place': expected finite numbers, found inf"),
        ({"per_step": ("place",)}, "key 'per_step': expected names of observed features, found place"),
        ({"scenes": torch.zeros(2, 3)}, r"key 'scenes': expected shape \(1, scene\), found \(2, 3\)"),
        ({"scenes": torch.full((1, 3), float("nan"))}, "key 'scenes': expected finite numbers, found nan"),
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
    if not Path("/dev/full").is_char_device():  # whoever wrote to it as root may have put a file there
        pytest.skip("needs the device /dev/full, which this system lacks")
    with pytest.raises(UserError, match="No space left on device"), atomic("file.txt"):
        Path("/dev/full").write_text("x")


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    for name, found in (("pipe", "a device"), ("folder", "a folder"), ("link", "a device"), ("null", "a device")):
        with pytest.raises(UserError, match=f"{name}: expected a file or nothing there, found {found}"):
            write_text(tmp_path / name, "x")
    assert (tmp_path / "pipe").is_fifo()
    assert Path("/dev/null").is_char_device()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "link", "null", "pipe"]


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to("elsewhere/file")
    for text in ("made", "replaced"):
        write_text(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "elsewhere" / "file").read_text() == text
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["file"]


def test_an_unwritable_folder_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/d\.safetensors: cannot be written"):
        demonstrations(torch.zeros(1, 1, 1)).save(tmp_path / "file" / "d.safetensors")


def test_windows_are_padded_with_the_last_state() -> None:
    states = torch.arange(10.0).reshape(2, 5, 1)
    whole = replace(demonstrations(states), lengths=torch.tensor([5, 3]), observed={"place": states + 100}, per_step=("place",))
    assert whole.starts(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 0.9999, 0.5, 0.9]), 3.0, 4).tolist() == [0, 4, 0, 2]
    found, seen = whole.windows(torch.tensor([0, 1]), torch.tensor([3, 0]), 4)
    assert found[..., 0].tolist() == [[3, 4, 4, 4], [5, 6, 7, 8]]
    assert seen["place"][:, 0].tolist() == [103, 105]


def test_windows_start_at_the_beginning_where_only_the_first_observation_is_known() -> None:
    whole = demonstrations(
        torch.zeros(2, 5, 1),
        lengths=torch.tensor([5, 3]),
        observed={"first": torch.eye(2), "always": torch.zeros(2, 5, 1)},
        per_step=("always",),
    )
    assert whole.starts(torch.tensor([0, 1]), torch.tensor([0.1, 0.9]), 3.0, 2).tolist() == [0, 0]
    assert torch.equal(whole.windows(torch.tensor([1]), torch.tensor([0]), 2)[1]["first"], torch.eye(2)[1:])


def test_where_nothing_is_observed_windows_stay_within_a_behaviour_and_one_as_long_starts_at_0() -> None:
    whole = demonstrations(torch.zeros(3, 9, 1), lengths=torch.tensor([9, 6, 2]))
    share = torch.rand(2000, generator=torch.Generator().manual_seed(0))
    rows = torch.arange(2000) % 3
    for exponent in (1.0, 3.0):
        for horizon in (1, 4, 6, 9, 20):
            starts = whole.starts(rows, share, exponent, horizon)
            for row, length in enumerate(whole.lengths.tolist()):
                latest = max(length - horizon, 0)
                found = starts[rows == row]
                assert found.min() == 0
                assert found.max() == latest  # all that fit are reached, and none goes over the end
    assert whole.starts(rows, share, 1.0, 9).max() == 0
    even = whole.starts(torch.zeros(2000, dtype=torch.int64), share, 1.0, 6).bincount()
    assert even.shape == (4,)
    assert even.min() > 400  # spread evenly over the four places


def test_images_stay_bytes_in_npz_files_and_in_our_own(tmp_path: Path) -> None:
    photos = np.arange(2 * 4 * 3 * 2 * 2, dtype=np.uint8).reshape(2, 4, 3, 2, 2)
    arrays = {"observed/photo": photos, "observed/place": np.ones((2, 3)), "scenes": np.ones((2, 5), dtype=np.uint8)}
    np.savez(tmp_path / "d.npz", states=np.ones((2, 4, 1), dtype=np.uint8), per_step=np.array(["photo"]), **arrays)
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.states.dtype == torch.float32  # bytes are images only among what is observed
    assert loaded.scenes is not None
    assert loaded.scenes.dtype == torch.float32
    assert loaded.features == {"photo": Feature((3, 2, 2), "image"), "place": Feature((3,))}
    loaded.save(tmp_path / "d.safetensors")
    again = Demonstrations.load(tmp_path / "d.safetensors")
    assert again.observed["photo"].dtype == torch.uint8
    assert np.array_equal(again.observed["photo"].numpy(), photos)
    assert again.features == loaded.features
    assert again.per_step == ("photo",)
    assert (tmp_path / "d.safetensors").stat().st_size < photos.nbytes + 2000
    first = again.initial_states
    assert np.array_equal(first.observed["photo"].numpy(), photos[:, 0])
    assert first.observed["place"].shape == (2, 3)
    assert first.scenes is not None
    assert first.scenes.shape == (2, 5)
    assert again.every_observation["photo"].shape == (8, 3, 2, 2)
    assert again.every_observation["place"].shape == (2, 3)


def test_a_feature_is_per_step_because_the_file_says_so_not_because_of_its_shape() -> None:
    # As many columns as times: the shape alone would not tell.
    states, square = torch.zeros(2, 4, 1), torch.arange(2 * 4 * 3.0).reshape(2, 4, 3)
    once = demonstrations(states, observed={"map": square})
    always = demonstrations(states, observed={"map": square}, per_step=("map",))
    assert once.features["map"].shape == (4, 3)
    assert always.features["map"].shape == (3,)
    assert torch.equal(once.initial_states.observed["map"], square)
    assert torch.equal(always.initial_states.observed["map"], square[:, 0])
    rows, starts = torch.tensor([1]), torch.tensor([2])
    assert torch.equal(once.windows(rows, starts, 2)[1]["map"], square[1:])
    assert torch.equal(always.windows(rows, starts, 2)[1]["map"], square[1:, 2])


def test_selecting_and_joining_keep_what_is_observed_and_scenes() -> None:
    def part(count: int, time: int, offset: float) -> Demonstrations:
        always = offset + torch.arange(count * time * 2.0).reshape(count, time, 2)
        return demonstrations(
            torch.full((count, time, 1), offset),
            observed={"always": always, "once": torch.full((count, 3), offset)},
            per_step=("always",),
            scenes=torch.full((count, 2), offset),
        )

    joined = concatenate([part(1, 2, 0.0), part(2, 4, 10.0)])
    assert joined.states.shape == (3, 4, 1)
    assert joined.lengths.tolist() == [2, 4, 4]
    assert joined.observed["always"][0].tolist() == [[0, 1], [2, 3], [2, 3], [2, 3]]  # padded with its last
    assert joined.observed["once"][:, 0].tolist() == [0, 10, 10]
    assert joined.scenes is not None
    assert joined.scenes[:, 0].tolist() == [0, 10, 10]
    one = joined.select("task 1")
    assert len(one) == 1
    assert one.observed["always"][0, 0].tolist() == [18, 19]
    assert one.scenes is not None
    assert one.scenes.tolist() == [[10, 10]]


def test_what_only_some_know_at_every_time_is_joined_at_the_first() -> None:
    values = torch.arange(6.0).reshape(1, 2, 3)
    always = demonstrations(torch.zeros(1, 2, 1), observed={"a": values}, per_step=("a",), scenes=torch.zeros(1, 2))
    once = demonstrations(torch.zeros(1, 4, 1), observed={"a": values[:, 1]})
    for parts in ([always, once], [once, always]):
        joined = concatenate(parts)
        assert joined.per_step == ()
        assert sorted(joined.observed["a"].tolist()) == [[0, 1, 2], [3, 4, 5]]
        assert joined.scenes is None


def test_what_is_observed_may_be_the_scene_itself(tmp_path: Path) -> None:
    same = torch.arange(6.0).reshape(2, 3)
    demonstrations(torch.zeros(2, 1, 1), observed={"world": same}, scenes=same).save(tmp_path / "d.safetensors")
    found = Demonstrations.load(tmp_path / "d.safetensors")
    assert found.scenes is not None
    assert torch.equal(found.scenes, found.observed["world"])
    assert torch.equal(found.scenes, same)


def test_the_hash_is_of_what_is_observed_and_scenes_too() -> None:
    states = torch.zeros(2, 3, 1)
    plain = demonstrations(states)
    seen = demonstrations(states, observed={"place": torch.zeros(2, 3)})
    others = [
        plain,
        seen,
        demonstrations(states, observed={"spot": torch.zeros(2, 3)}),
        demonstrations(states, observed={"place": torch.ones(2, 3)}),
        demonstrations(states, scenes=torch.zeros(2, 3)),
    ]
    assert len({one.hash for one in others}) == len(others)
    assert replace(seen, concepts=("x", "y"), provenance={"seed": 1}).hash == seen.hash


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
    header = {
        "domain": "driving",
        "state_names": drives.state_names,
        "state_units": drives.state_units,
        "concepts": drives.concepts,
        "provenance": {},
    }
    tensors = {"states": drives.states, "lengths": drives.lengths, "initial_states": old}
    save_tensors(tmp_path / "old.safetensors", "demonstrations", tensors, header, 1)
    found = Demonstrations.load(tmp_path / "old.safetensors").fitted(domain.observed)
    assert found.per_step == drives.per_step
    for name, values in drives.observed.items():
        assert torch.equal(found.observed[name], values)
    assert torch.equal(found.initial_states.require_scenes(), scenes)
    assert found.hash == drives.hash


def test_features_that_a_domain_does_not_find_are_told() -> None:
    seen = demonstrations(torch.zeros(2, 3, 1), observed={"place": torch.zeros(2, 3)})
    assert seen.fitted({"place": Feature((3,))}) is seen
    assert seen.fitted({}) is seen
    with pytest.raises(
        UserError, match=r"key 'observed/place': expected float32 of shape \(4,\) each, found float32 of shape \(3,\)"
    ):
        seen.fitted({"place": Feature((4,))})
    with pytest.raises(UserError, match=r"key 'observed/photo': expected uint8 images of shape \(3, 8, 8\) each, found none"):
        seen.fitted({"photo": Feature((3, 8, 8), "image")})
    with pytest.raises(UserError, match=r"expected uint8 images of shape \(3,\) each, found float32 of shape \(3,\)"):
        seen.fitted({"place": Feature((3,), "image")})
    with pytest.raises(UserError, match="key 'observed/place': expected float32, or uint8 for images, found float64"):
        demonstrations(torch.zeros(2, 3, 1), observed={"place": torch.zeros(2, 3, dtype=torch.float64)})


# Images in files


def filmed(always: bool = True) -> Demonstrations:
    """Two demonstrations with pictures of a square that moves over noise."""
    draw = torch.Generator().manual_seed(0)
    pictures = torch.randint(256, (2, 1, 3, 32, 32), generator=draw, dtype=torch.uint8).repeat(1, 40, 1, 1, 1)
    for time in range(40):
        pictures[:, time, :, time // 2 : time // 2 + 5, 10:15] = 255
    return demonstrations(
        torch.zeros(2, 40, 1),
        observed={"photo": pictures if always else pictures[:, 7], "place": torch.ones(2, 3)},
        per_step=("photo",) if always else (),
    )


def stored(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """What is in a file, whatever it means."""
    with safetensors.safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["ftl_lightning"])
        return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118


@pytest.mark.parametrize("always", [True, False])
def test_images_are_compressed_in_files_bit_for_bit(always: bool, tmp_path: Path) -> None:
    path, before = tmp_path / "d.safetensors", filmed(always)
    before.save(path)
    tensors, header = stored(path)
    assert (header["format"], header["compressed"]) == (3, {"observed/photo": list(before.observed["photo"].shape)})
    assert tensors["observed/photo"].dim() == 1
    assert tensors["observed/photo"].dtype == torch.uint8
    after = Demonstrations.load(path)
    assert torch.equal(after.observed["photo"], before.observed["photo"])
    assert (after.features, after.hash) == (before.features, before.hash)
    after.observed["photo"][0] = 0  # it can be written to
    if always:
        assert path.stat().st_size < before.observed["photo"].nbytes / 10


def test_files_without_images_keep_their_form_and_their_bytes(tmp_path: Path) -> None:
    path, plain = tmp_path / "d.safetensors", demonstrations(torch.ones(2, 3, 1), observed={"place": torch.ones(2, 3)})
    plain.save(path)
    header = {
        "domain": plain.domain,
        "state_names": plain.state_names,
        "state_units": plain.state_units,
        "concepts": plain.concepts,
        "per_step": (),
        "provenance": {},
    }
    assert path.read_bytes() == serialise("demonstrations", plain.tensors, header, 2)


def test_files_of_the_second_form_load_with_images_that_are_not_compressed(tmp_path: Path) -> None:
    path, before = tmp_path / "d.safetensors", filmed()
    header = {"concepts": before.concepts, "per_step": before.per_step}
    save_tensors(path, "demonstrations", before.tensors, header, 2)
    after = Demonstrations.load(path)
    assert torch.equal(after.observed["photo"], before.observed["photo"])
    assert after.hash == before.hash


def squeezed(count: int) -> torch.Tensor:
    return torch.frombuffer(bytearray(zlib.compress(bytes(count))), dtype=torch.uint8)


PHOTO = "observed/photo"
SIZE = 2 * 40 * 3 * 32 * 32
FITS = r"expected images of shape \(2, 40, ...\) that fit into \d+ compressed bytes, found the shape "


@pytest.mark.parametrize(
    ("tensors", "header", "message"),
    [
        ({PHOTO: torch.full((999,), 7, dtype=torch.uint8)}, {}, "expected compressed images, found damaged bytes"),
        ({PHOTO: squeezed(SIZE)[:-3]}, {}, f"expected {SIZE} bytes of images, found {SIZE} and no end; the file is damaged"),
        ({PHOTO: squeezed(SIZE)[:-20]}, {}, rf"expected {SIZE} bytes of images, found \d+ and no end"),
        ({PHOTO: squeezed(SIZE - 1)}, {}, f"expected {SIZE} bytes of images, found {SIZE - 1}; the file is damaged"),
        ({PHOTO: squeezed(SIZE + 1)}, {}, f"expected {SIZE} bytes of images, found more"),
        ({PHOTO: torch.cat((squeezed(SIZE), squeezed(5)))}, {}, f"expected {SIZE} bytes of images, found more"),
        ({PHOTO: torch.empty(0, dtype=torch.uint8)}, {}, FITS),
        ({PHOTO: torch.zeros(99)}, {}, r"expected compressed images, uint8 of shape \(byte,\) .*, found float32 of shape \(99,\)"),
        ({PHOTO: torch.zeros(9, 9, dtype=torch.uint8)}, {}, r"expected compressed images, .*, found uint8 of shape \(9, 9\)"),
        ({}, {"compressed": {PHOTO: [2, 40, 3, 1 << 40, 1 << 40]}}, FITS),
        ({}, {"compressed": {PHOTO: [2, 40, -3, -32, 32]}}, FITS),
        ({}, {"compressed": {PHOTO: [2, 39, 3, 32, 32]}}, FITS),
        ({}, {"compressed": {PHOTO: [3, 40, 3, 32, 32]}}, FITS),
        ({}, {"compressed": {PHOTO: [2]}}, FITS),
        ({}, {"compressed": {PHOTO: [2, 40, 3, 32.0, 32]}}, FITS),
        ({}, {"compressed": {PHOTO: [2, 40, 3, True, 32]}}, FITS),
        ({}, {"compressed": {PHOTO: "2, 40"}}, FITS),
        ({}, {"compressed": {PHOTO: [2, 40]}}, rf"{PHOTO}': expected 80 bytes of images, found more"),
        ({}, {"compressed": {"observed/view": [2, 40, 3]}}, "key 'observed/view': expected compressed images, .*, found nothing"),
        ({}, {"compressed": {"lengths": [2]}}, "key 'lengths': expected compressed images, .*, found int64 of shape"),
        ({}, {"compressed": [PHOTO]}, "key 'compressed': expected shapes of images by key, found \\['observed/photo'\\]"),
        ({}, {"compressed": None}, "key 'compressed': expected shapes of images by key, found None"),
        ({}, {"compressed": {}}, r"key 'observed/photo': expected shape \(2, 40, ...\), found"),
        ({"states": torch.zeros(2, 40)}, {}, "key 'states': expected float32"),
        ({}, {"per_step": 5}, "key 'per_step': expected a list of texts, found 5"),
        ({}, {"concepts": ["a", 3]}, "key 'concepts': expected a list of texts, found"),
    ],
)
def test_damaged_images_are_told_in_one_line(
    tensors: dict[str, torch.Tensor], header: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    found, told = stored(path)
    save_tensors(path, "demonstrations", found | tensors, {**told, **header}, 3)
    with pytest.raises(UserError, match=message) as error:
        Demonstrations.load(path)
    assert str(error.value).startswith(f"{path}: key ")
    assert "\n" not in str(error.value)


def test_nothing_is_decompressed_beyond_what_the_header_says(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    tensors, header = stored(path)
    save_tensors(path, "demonstrations", tensors | {PHOTO: squeezed(100_000_000)}, header, 3)
    tracemalloc.start()
    with pytest.raises(UserError, match="found more"):
        Demonstrations.load(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5_000_000


def test_flipped_bits_of_compressed_images_are_found(tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    filmed().save(path)
    tensors, header = stored(path)
    for place in range(0, len(tensors[PHOTO]), 97):
        damaged = tensors[PHOTO].clone()
        damaged[place] ^= 1 << (place % 8)
        save_tensors(path, "demonstrations", tensors | {PHOTO: damaged}, header, 3)
        with pytest.raises(UserError, match="key 'observed/photo'"):
            Demonstrations.load(path)
