import numpy as np
import pytest

from ftl_lightning.apps.testing.strokes import NEW, STEPS, TRAINING, recognised, strokes


@pytest.mark.parametrize("kind", [*TRAINING, *NEW])
def test_fresh_strokes_are_recognised_and_differ_from_each_other(kind: str) -> None:
    found = strokes(kind, 200, seed=7)
    assert found.shape == (200, STEPS, 2)
    assert found.dtype == np.float32
    assert recognised(found).count(kind) >= 196
    assert found.std(axis=0).min() > 0.5  # of every point, in centimetres
    assert np.array_equal(found, strokes(kind, 200, seed=7))
    assert not np.array_equal(found, strokes(kind, 200, seed=8))


def test_place_and_size_do_not_matter_for_what_a_stroke_is_and_noise_is_none() -> None:
    found = strokes("heart", 20, seed=3)
    assert recognised(3 * found + 50) == recognised(found)
    noise = np.random.default_rng(0).normal(size=(200, STEPS, 2)).astype(np.float32)
    assert max(map(recognised(noise).count, [*TRAINING, *NEW])) < 0.3 * 200  # noise is no kind rather than another
