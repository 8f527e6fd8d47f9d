"""What is read of images: by each network, once a plan, trained and averaged with the rest of a model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ftl_lightning.data.features import Feature
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import BudgetOptions
from ftl_lightning.methods.ftl_igm.model import GenerativeModel
from ftl_lightning.methods.ftl_igm.pretraining import LossOptions, PretrainingModule
from ftl_lightning.methods.pretraining import CloningPretraining, InContextPretraining
from ftl_lightning.networks.image_encoder import ImageEncoder, ImageEncoders, ObjectAttention, SpatialSoftmax
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.randomness import generator
from ftl_lightning.training.adaptation import LearnerAdaptation
from ftl_lightning.training.data import InversionData, OwnData
from ftl_lightning.training.inversion_module import InversionModule
from ftl_lightning.training.model_folder import load_model, read_model
from ftl_lightning.training.trainer import Trainer

SHAPE = (3, 32, 24)
SIDE, TIME = 16, 6


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({}, 96),
        ({"widths": [8], "keypoints": 4}, 12),
        ({"widths": [8, 16], "head": "grid", "keypoints": 2}, 2 * 8 * 6),
        ({"network": "resnet18", "head": "grid", "keypoints": 4}, 4 * 1 * 1),
        ({"crop": 4, "head": "grid", "keypoints": 1}, 7 * 5),
        ({"stride": 2, "head": "grid", "keypoints": 1}, 16 * 12),
        ({"head": "points", "points": 5, "keypoints": 2}, 20),
        ({"head": "objects", "points": 5, "keypoints": 2}, 20),
    ],
)
def test_sizes(options: dict[str, Any], size: int) -> None:
    encoder = ImageEncoder(SHAPE, **options)
    images = torch.randint(256, (5, *SHAPE), dtype=torch.uint8)
    for training in (True, False):
        found = encoder.train(training)(images)
        assert found.shape == (5, size)
        assert found.isfinite().all()
    assert encoder.size == size
    # What a running average of the weights does not hold would be lost in the model that is saved.
    assert not list(encoder.buffers())
    assert not any(isinstance(module, nn.BatchNorm2d) for module in encoder.modules())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"network": "vit"}, "model.image_encoder.network: expected one of small, resnet18, found 'vit'"),
        ({"head": "mean"}, "model.image_encoder.head: expected one of keypoints, points, objects, grid, found 'mean'"),
        ({"stride": 3}, "model.image_encoder.stride: expected one of 2, 4, found 3"),
        ({"head": "points"}, "model.image_encoder.points: expected 1 or more for points, found 0"),
        ({"head": "objects"}, "model.image_encoder.points: expected 1 or more for objects, found 0"),
        ({"points": 2}, "model.image_encoder.points: expected 0 for keypoints, found 2"),
        ({"widths": [12]}, r"model.image_encoder.widths: expected multiples of 8, found \[12\]"),
        ({"widths": []}, r"model.image_encoder.widths: expected multiples of 8, found \[\]"),
        ({"origin": "hand"}, "model.image_encoder.origin: expected an observed vector of 2 columns, found 'hand'"),
        ({"origin": "view"}, "model.image_encoder.origin: expected an observed vector of 2 columns, found 'view'"),
        (
            {"origin": "hand", "head": "grid"},
            "model.image_encoder.origin: expected none for a head without keypoints, found 'hand'",
        ),
        ({"crop": 20}, "model.image_encoder.crop: expected images of 8 x 8 or more for the small network, found 12 x 4"),
        ({"crop": 24}, "model.image_encoder.crop: expected a number from 0 to 23, found 24"),
        ({"keypoints": 0}, "model.image_encoder.keypoints: expected 1 or more, found 0"),
        (
            {"depth": 3},
            "key .model.image_encoder.depth.: expected one of network, widths, stride, head, keypoints, points, crop, origin",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ImageEncoders({"view": Feature(SHAPE, "image")}, options)


def test_a_keypoint_is_where_its_map_is_largest() -> None:
    softmax = SpatialSoftmax(1, 1)
    nn.init.constant_(softmax.maps.weight, 50.0)
    maps = torch.zeros(2, 1, 5, 9)
    maps[0, 0, 0, 8] = maps[1, 0, 3, 2] = 1
    expected = torch.tensor([[1.0, -1.0], [-0.5, 0.5]])  # column, row
    torch.testing.assert_close(softmax(maps)[:, :2], expected, atol=1e-4, rtol=0)


def test_attention_to_an_object_moves_with_it_and_ignores_others() -> None:
    torch.manual_seed(0)
    head = ObjectAttention(2, 2, 1)
    nn.init.zeros_(head.maps.bias)
    head.maps.weight.data[:, :, 0, 0] = 50 * torch.eye(2)  # object 0 is where channel 0 is active, object 1 where channel 1 is
    nn.init.eye_(head.place.weight)
    for module in (head.first, head.second):
        nn.init.zeros_(module.weight)
        nn.init.zeros_(module.bias)
    maps = torch.zeros(2, 2, 5, 9)
    maps[:, 0, 0, 8] = maps[0, 1, 2, 4] = maps[1, 1, 3, 2] = 1
    found = head(maps).unflatten(1, (4, 2)).transpose(1, 2)  # (image, object, value)
    expected = torch.tensor([[[1.0, -1.0], [0.0, 0.0]], [[1.0, -1.0], [-0.5, 0.5]]])
    torch.testing.assert_close(found[..., :2], expected, atol=1e-4, rtol=0)
    head.second.weight.data.normal_()
    head.first.weight.data.normal_()
    found = head(maps).unflatten(1, (4, 2)).transpose(1, 2)
    torch.testing.assert_close(found[0, 0], found[1, 0])  # the other object has moved


def test_keypoints_are_told_from_their_origin() -> None:
    features = {"view": Feature(SHAPE, "image"), "other": Feature(SHAPE, "image"), "hand": Feature((2,))}
    encoders = ImageEncoders(features, {"keypoints": 4, "origin": "hand"})
    hand = torch.tensor([[0.25, -0.5], [0.0, 1.0]])
    read = torch.arange(2 * 24.0).reshape(2, 24)
    moved = read - encoders.from_origins(read, {"hand": hand})
    assert encoders.size == 24
    for number, (column, row) in enumerate(hand.tolist()):
        assert moved[number].tolist() == 2 * [*[column] * 4, *[row] * 4, *[0.0] * 4]
    points = ImageEncoders(features, {"head": "points", "points": 3, "origin": "hand"})
    moved = read - points.from_origins(read, {"hand": hand})
    for number, (x, y) in enumerate(hand.tolist()):
        assert moved[number].tolist() == 2 * [*[x] * 3, *[y] * 3, *[0.0] * 6]
    plain = ImageEncoders(features, {"keypoints": 4})
    assert torch.equal(plain.from_origins(read, {}), read)


def test_crops_are_random_in_training_and_in_the_middle_else() -> None:
    encoder = ImageEncoder((1, 12, 12), widths=[8], crop=2)
    seen: list[Tensor] = []
    encoder.network.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    image = torch.arange(144, dtype=torch.uint8).reshape(1, 1, 12, 12)
    encoder.eval()(image)
    torch.testing.assert_close(seen[0], image[:, :, 1:11, 1:11].float() / 127.5 - 1)
    torch.manual_seed(0)
    encoder.train()(image.expand(200, -1, -1, -1))
    corners = ((seen[1][:, 0, 0, 0] + 1) * 127.5).round().long()
    assert set(corners.tolist()) == {12 * row + column for row in range(3) for column in range(3)}


# In models: ways to a bright dot or away from it, where the dot is seen in a picture alone


def ways(concept: str, count: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    dots = rng.integers(2, SIDE - 2, (count, 2))
    images = np.zeros((count, 1, SIDE, SIDE), np.uint8)
    for image, (x, y) in zip(images, dots, strict=True):
        image[0, y - 1 : y + 2, x - 1 : x + 2] = 255
    middle = np.full((count, 2), SIDE / 2)
    goals = dots if concept == "to" else 2 * middle - dots
    share = np.linspace(0, 1, TIME)[:, None]
    states = middle[:, None] + (goals - middle)[:, None] * share
    return {
        "states": states.astype(np.float32),
        "observed/view": images,
        "observed/place": middle.astype(np.float32) + rng.normal(0, 0.1, middle.shape).astype(np.float32),
        "concepts": np.array([concept] * count),
    }


def write(path: Path, *parts: dict[str, np.ndarray], **more: np.ndarray) -> str:
    np.savez(path, **{key: np.concatenate([part[key] for part in parts]) for key in parts[0]}, **more)  # type: ignore[arg-type]
    return str(path)


def trainer(**options: Any) -> Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(accelerator="cpu", default_root_dir="logs", **(quiet | options))


SMALL: dict[str, Any] = {"image_encoder": {"widths": [8, 16], "keypoints": 4}, "feature_dropout": {"place": 0.4}}
BOTH = (ways("to", 12, 0), ways("away", 12, 1))


def own(file: str, steps: int = 3, batch_size: int = 8, **options: int) -> OwnData:
    return OwnData(file, batch_size=batch_size, steps_per_epoch=steps, encoder="hashing", **options)


def pretraining(output: Path, width: int = 16, learning_rate: float = 1e-2, **options: Any) -> PretrainingModule:
    network = {"hidden_dim": width, "depth": 2, "condition_dim": width // 2}
    options |= {"learning_rate": learning_rate, "diffusion_steps": 20, "output": str(output)}
    return PretrainingModule(denoiser_args=network, **SMALL, **options)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a model that has hardly learned to see pictures, and beside it the file that it was fitted to."""
    folder = tmp_path_factory.mktemp("seen")
    trainer(max_steps=3).fit(pretraining(folder / "model"), datamodule=own(write(folder / "ways.npz", *BOTH)))
    return folder / "model"


def error(model: GenerativeModel, concept: str) -> float:
    """Mean distance in pixels of where new ways end from where the picture says that they should."""
    new = ways(concept, 40, 7)
    observed = {name: torch.from_numpy(new[f"observed/{name}"]) for name in ("view", "place")}
    composition = Composition(model.concept(concept)[None, None], torch.ones(1))
    plans = model.sample([composition], 40, Sampling("ddim", 10, 0.1), [generator("cpu", 0)], observed)[0]
    return float((plans[:, -1] - torch.from_numpy(new["states"][:, -1])).norm(dim=-1).mean())


@pytest.mark.slow
def test_a_model_sees_where_to_go(tmp_path: Path) -> None:
    learned = {"diffusion_steps": 20, "prediction": "clean", "loss": LossOptions(kind="clean")}
    module = pretraining(tmp_path / "model", 64, 3e-3, warmup_steps=20, ema_decay=0.98, **learned)
    file = write(tmp_path / "ways.npz", ways("to", 300, 0), ways("away", 300, 1))
    trainer(max_steps=500).fit(module, datamodule=own(file, 500, 64))
    for concept in ("to", "away"):
        assert error(module.model, concept) < 1.5  # by chance 5


def test_a_model_that_sees_comes_back_from_its_folder(fitted: Path) -> None:
    model = load_model(fitted)
    assert isinstance(model, GenerativeModel)
    assert model.config.image_dim == 12
    assert dict(model.config.feature_dropout) == {"place": 0.4}
    again = read_model(GenerativeModel, fitted)
    assert again.hash == model.hash


def test_the_encoder_is_part_of_the_running_average(tmp_path: Path) -> None:
    module = pretraining(tmp_path / "model", warmup_steps=0)
    seen: list[dict[str, Tensor]] = []
    plain = module.on_train_start

    def begin() -> None:
        plain()
        seen.append({name: value.clone() for name, value in module.model.named_parameters()})

    module.on_train_start = begin  # type: ignore[method-assign]
    trainer(max_steps=3).fit(module, datamodule=own(write(tmp_path / "ways.npz", *BOTH)))
    raw, average = dict(module.raw.named_parameters()), dict(module.model.named_parameters())
    images = [name for name in average if name.startswith("images.")]
    assert images
    for name in images:
        assert not torch.equal(average[name], seen[0][name]), name
        assert not torch.equal(average[name], raw[name]), name


def test_vectors_are_hidden_in_training_alone(fitted: Path) -> None:
    model = load_model(fitted)
    new = ways("to", 400, 3)
    observed = {name: torch.from_numpy(new[f"observed/{name}"]) for name in ("view", "place")}
    whole = model.vector(observed)
    torch.manual_seed(0)
    part = model.train().vector(observed)
    model.eval()
    hidden = (part[:, :2] == 0).all(dim=1)
    assert 0.3 < hidden.float().mean() < 0.5
    torch.testing.assert_close(part[~hidden], whole[~hidden])
    torch.testing.assert_close(part[:, 2:], whole[:, 2:])


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many images were read at once, each time that some were."""
    found: list[int] = []
    plain = ImageEncoder.forward
    monkeypatch.setattr(ImageEncoder, "forward", lambda self, images: found.append(len(images)) or plain(self, images))  # type: ignore[func-returns-value]
    return found


def test_images_are_read_once_a_plan_and_concepts_are_learned_through_them(fitted: Path, calls: list[int]) -> None:
    error(read_model(GenerativeModel, fitted), "to")
    assert calls == [40]
    calls.clear()
    file = write(Path("new.npz"), ways("away", 5, 11))
    module = InversionModule(str(fitted), budget=BudgetOptions(samples=16), components=1, output="concepts", form="paper")
    trainer(max_epochs=1).invert(module, InversionData("own", demonstrations=file, steps=4))
    # Once a step; the rest is where demonstrations are checked, and the learned concept and its samples are looked at.
    assert calls.count(16) == 4
    assert set(calls) == {16, 40, 128}
    assert Path("concepts/away.safetensors").is_file()


def test_mistakes_in_what_is_hidden(fitted: Path) -> None:
    with pytest.raises(UserError, match=r"model\.feature_dropout\.place: expected a number from 0 to 1, found 2.0"):
        PretrainingModule(feature_dropout={"place": 2.0})
    with pytest.raises(UserError, match=r"model\.feature_dropout: expected one of place, found 'view'"):
        trainer(max_steps=1).fit(PretrainingModule(feature_dropout={"view": 0.5}), datamodule=own(str(fitted.parent / "ways.npz")))


def test_cloning_looks_once_and_in_context_learning_takes_a_trained_encoder(fitted: Path, calls: list[int]) -> None:
    cloning = CloningPretraining(hidden_dim=16, output="bc", plan_horizon=2, **SMALL)
    trainer(max_steps=2).fit(cloning, datamodule=own(str(fitted.parent / "ways.npz"), 2, horizon=2))
    observed = {name: torch.from_numpy(ways("to", 3, 0)[f"observed/{name}"]) for name in ("view", "place")}
    model = load_model("bc")
    calls.clear()
    composition = Composition(model.concept("to")[None, None], torch.ones(1))
    assert model.sample([composition], 3, Sampling(), [generator("cpu", 0)], observed).shape == (1, 3, 2, 2)
    assert calls == [3]

    # At every time, as in-context learning asks for.
    parts = [
        {key: np.repeat(values[:, None], TIME, axis=1) if key.startswith("observed/") else values for key, values in part.items()}
        for part in BOTH
    ]
    seen = write(Path("seen.npz"), *parts, per_step=np.array(["view", "place"]))
    options: dict[str, Any] = {"tokens": 3, "bins": 4, "width": 8, "layers": 1, "heads": 2, "prompts": 2, "plan_horizon": 2}
    data = own(seen, 2, horizon=2)
    with pytest.raises(UserError, match=r"model\.images: expected the folder of a model that reads these images, found none"):
        trainer(max_steps=2).fit(InContextPretraining(**options), datamodule=data)
    trainer(max_steps=2).fit(InContextPretraining(**options, images=str(fitted), output="icl"), datamodule=data)
    source, read = load_model(fitted).images, load_model("icl").images
    for name, weight in source.state_dict().items():
        assert torch.equal(read.state_dict()[name], weight), name
    trainer(max_epochs=1).invert(LearnerAdaptation("icl", output="prompts"), InversionData("own", demonstrations=seen, steps=1))
    assert sorted(path.name for path in Path("prompts").iterdir()) == ["away.safetensors", "to.safetensors"]
