from pathlib import Path

import numpy as np
import pytest
import torch

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import Feature
from ftl_lightning.services.errors import UserError
from tests.data.recorded import everything, expect_same


def test_npz_is_accepted_without_objects(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", states=np.ones((2, 1, 21)), concepts=np.array(["a", "b"]))
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.states.shape == (2, 1, 21)
    assert loaded.states.dtype == torch.float32
    assert loaded.concepts == ("a", "b")
    np.savez(tmp_path / "o.npz", states=np.array([{}], dtype=object))
    with pytest.raises(UserError, match=r"o\.npz: expected an \.npz of plain arrays"):
        Demonstrations.load(tmp_path / "o.npz")


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written = everything()
    written.save(tmp_path / "d.npz")
    expect_same(Demonstrations.load(tmp_path / "d.npz"), written, provenance=False)
    assert dict(np.load(tmp_path / "d.npz", allow_pickle=False))["concepts"].tolist() == list(written.concepts)
    assert [path.name for path in tmp_path.iterdir()] == ["d.npz"]


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
