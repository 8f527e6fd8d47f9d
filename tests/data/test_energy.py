"""The energy score on several features: what lowers the skill of samples, and that it has no bias."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from ftl_lightning.data.distances import PathFeatures, ceiling


def loops(count: int, seed: int, wave: float = 3.0) -> Tensor:
    """Loops in the plane with a ripple, of random size, phase and place ``(count, 40, 2)``."""
    draw = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 2 * math.pi, 40)
    phase, size = 0.4 * torch.randn(count, 1, generator=draw), 1 + 0.15 * torch.randn(count, 1, generator=draw)
    place = 0.2 * torch.randn(count, 1, 2, generator=draw)
    radius = size * (1 + 0.15 * torch.sin(wave * (time + phase) * 2))
    path = torch.stack((radius * torch.cos(time + phase), radius * torch.sin(time + phase)), dim=2) + place
    return path + 0.02 * torch.randn(path.shape, generator=draw)


@pytest.fixture(scope="module")
def features() -> PathFeatures:
    return PathFeatures(torch.cat((loops(40, 1), loops(40, 2, wave=1.0), loops(40, 3, wave=5.0))))


def score(features: PathFeatures, samples: Tensor, truth: Tensor) -> Tensor:
    """Mean score of each feature ``(feature,)``."""
    return features.scores(samples.expand(len(truth), *samples.shape), truth).mean(dim=0)


def blurred(paths: Tensor) -> Tensor:
    kernel = torch.ones(2, 1, 9) / 9
    padded = torch.nn.functional.pad(paths.mT, (4, 4), mode="replicate")
    return torch.nn.functional.conv1d(padded, kernel, groups=2).mT


WRONG: dict[str, Callable[[Tensor], Tensor]] = {
    "copies": lambda paths: paths[:4].repeat(len(paths) // 4, 1, 1),
    "blur": blurred,
    "noise": lambda paths: paths + 0.1 * torch.randn(paths.shape, generator=torch.Generator().manual_seed(5)),
    "a missing part": lambda paths: torch.cat((paths[:, :28], paths[:, 27:28].expand(-1, 12, -1)), dim=1),
    "a wrong place": lambda paths: paths + 0.6,
    "one path": lambda paths: paths.mean(dim=0, keepdim=True).expand_as(paths),
    "another kind": lambda paths: loops(len(paths), 9, wave=1.0),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_wrong_samples_have_a_higher_score_than_fresh_behaviour(features: PathFeatures, wrong: Callable[[Tensor], Tensor]) -> None:
    fresh, truth = loops(64, 20), loops(100, 30)
    assert float(score(features, wrong(fresh), truth).mean()) > float(score(features, fresh, truth).mean()) + 0.01


def test_the_path_alone_hardly_sees_shape(features: PathFeatures) -> None:
    fresh, truth = loops(64, 20), loops(100, 30)
    more = score(features, blurred(fresh), truth) / score(features, fresh, truth)
    path, *others = more.tolist()
    assert path < 1.05
    assert max(others) > 1.2


def test_fresh_demonstrations_have_the_score_of_the_ceiling_for_any_number_of_samples(features: PathFeatures) -> None:
    wanted = ceiling(features, loops(200, 40))
    for count in (4, 16):
        truth = loops(60, 100)
        samples = loops(60 * count, 200).unflatten(0, (60, count))
        torch.testing.assert_close(features.scores(samples, truth).mean(dim=0), wanted, rtol=0.15, atol=0.0)
        copies = samples[:, :2].repeat(1, count // 2, 1, 1)
        assert bool((features.scores(copies, truth).mean(dim=0) > 1.1 * wanted).all())


def test_a_single_state_has_the_feature_of_the_path_alone() -> None:
    features = PathFeatures(torch.randn(20, 1, 6, generator=torch.Generator().manual_seed(0)))
    assert features.scores(torch.zeros(3, 5, 1, 6), torch.zeros(3, 1, 6)).tolist() == [[0.0]] * 3
