import pytest
import torch

from ftl_lightning.data.features import Feature, InitialStates, check_features, check_starts, joined, joined_starts, moved, take
from ftl_lightning.services.errors import UserError


def observed(count: int, offset: float = 0.0) -> dict[str, torch.Tensor]:
    photos = torch.full((count, 3, 2, 2), int(offset), dtype=torch.uint8)
    return {"place": offset + torch.arange(count * 2.0).reshape(count, 2), "photo": photos}


def test_samples_are_taken_joined_and_moved_feature_by_feature() -> None:
    assert Feature((7,)).size == 7
    assert Feature((3, 4, 5), "image").size == 60  # the numbers in one sample
    both = joined([observed(2), observed(1, 9.0)])
    assert both["place"].tolist() == [[0, 1], [2, 3], [9, 10]]
    assert both["photo"].dtype == torch.uint8
    assert take(both, [2, 0])["place"].tolist() == [[9, 10], [0, 1]]
    assert take(both, 1)["place"].tolist() == [2, 3]
    assert moved(both, torch.device("cpu"))["photo"].dtype == torch.uint8
    assert joined([]) == {}
    assert joined([{}, {}]) == {}


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ({"speed": Feature((1,))}, r"key 'observed': expected the feature 'speed', float32 of shape \(1,\), found place, photo"),
        (
            {"place": Feature((3,))},
            r"key 'observed/place': expected float32 of shape \(3,\) a sample, found float32 of shape \(2,\)",
        ),
        ({"photo": Feature((3, 2, 2))}, "expected float32 of shape .* a sample, found uint8 images of shape"),
        ({"place": Feature((2,), "image")}, "expected uint8 images of shape .* a sample, found float32 of shape"),
    ],
)
def test_features_that_are_missing_or_of_another_shape_are_told(features: dict[str, Feature], message: str) -> None:
    check_features(observed(2), {"place": Feature((2,)), "photo": Feature((3, 2, 2), "image")})
    with pytest.raises(UserError, match=message):
        check_features(observed(2), features)


def test_initial_states_are_counted_by_what_there_is_and_are_taken_and_joined() -> None:
    some = (
        InitialStates(),
        InitialStates(observed(3)),
        InitialStates(scenes=torch.zeros(4, 2)),
        InitialStates(observed(3), torch.zeros(3, 2)),
    )
    assert [len(one) for one in some] == [0, 3, 4, 3]
    one, other = InitialStates(observed(2), torch.zeros(2, 4)), InitialStates(observed(1, 9.0), torch.ones(1, 4))
    both = joined_starts([one, other])
    assert len(both) == 3
    last = both.take(slice(2, 3))
    assert last.observed["place"].tolist() == [[9, 10]]
    assert last.require_scenes().tolist() == [[1, 1, 1, 1]]
    assert both.take([2, 0]).require_scenes()[:, 0].tolist() == [1, 0]
    unseen = joined_starts([InitialStates(observed(1)), InitialStates(observed(1))])
    assert unseen.scenes is None
    assert unseen.take([0]).scenes is None
    assert len(joined_starts([])) == 0


def test_scenes_and_initial_states_that_are_missing_are_told_where_nothing_goes_without() -> None:
    starts = InitialStates(observed(2))
    with pytest.raises(UserError, match=r"key 'scenes': expected \(sample, scene\), by which an environment is reset, found none"):
        starts.require_scenes()
    assert check_starts(starts) is starts
    with pytest.raises(UserError, match="expected initial states, found none; give the observed features where plans start"):
        check_starts(None)
