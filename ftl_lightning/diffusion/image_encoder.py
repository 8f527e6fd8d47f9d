"""What a network reads of an image: a few numbers, trained with the rest of it."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.demonstrations.features import Feature, Observed
from ftl_lightning.errors import UserError, short, shown
from ftl_lightning.ranges import expect_range
from ftl_lightning.schema import built

MOST_PIXELS = 100_000_000
"""Numbers of an image."""
GROUPS = 8
"""Of group normalisation, which replaces batch normalisation: that keeps statistics beside the weights, which no running average
of weights holds (Chi et al., 2023)."""
QUARTER = 4
RESNET18 = "resnet18"
NETWORKS = ("small", RESNET18)
HEADS = ("keypoints", "grid")


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with group normalisation (He et al., 2016).

    Args:
        inputs, outputs: channels.
        stride: of the first convolution.
    """

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, outputs) for _ in range(2))
        self.skip = nn.Conv2d(inputs, outputs, 1, stride, bias=False) if stride > 1 or inputs != outputs else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, inputs, height, width)`` to ``(batch, outputs, height / stride, width / stride)``."""
        hidden = functional.relu(self.norms[0](self.first(x)))
        out: Tensor = functional.relu(self.norms[1](self.second(hidden)) + self.skip(x))
        return out


class SpatialSoftmax(nn.Module):
    """Where in the image each channel is largest, and how large (Levine et al., 2016).

    Args:
        channels: of the feature map.
        keypoints: how many.
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.maps = nn.Conv2d(channels, keypoints, 1)

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` to column, row (-1 to 1) and height of each keypoint ``(batch, 3 * keypoints)``."""
        maps = self.maps(x)
        height, width = maps.shape[2:]
        share = maps.flatten(2).softmax(dim=-1).unflatten(-1, (height, width))
        column = share.sum(dim=2) @ torch.linspace(-1, 1, width, device=x.device)
        row = share.sum(dim=3) @ torch.linspace(-1, 1, height, device=x.device)
        return torch.cat((column, row, (share * maps).sum(dim=(2, 3)).tanh()), dim=-1)


class Grid(nn.Module):
    """All of the last feature map, with fewer channels.

    Args:
        channels: of the feature map.
        kept: channels that are kept.
        height, width: of the feature map.
    """

    def __init__(self, channels: int, kept: int, height: int, width: int) -> None:
        super().__init__()
        self.kept = nn.Conv2d(channels, kept, 1)
        self.size = kept * height * width

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` to ``(batch, size)``."""
        out: Tensor = self.kept(x).flatten(1)
        return out


def _small(channels: int, widths: Sequence[int], height: int, width: int) -> tuple[nn.Module, tuple[int, int, int]]:
    """A residual network whose feature map is a quarter of the image in each direction, and that map's shape.

    The first convolution goes there at once: convolutions of few channels on many pixels take most of the time of deeper stems.
    """
    first = nn.Conv2d(channels, widths[0], 2 * QUARTER, QUARTER, padding=QUARTER // 2, bias=False)
    blocks = [ResidualBlock(before, after, 1) for before, after in itertools.pairwise(widths)]
    height, width = ((side + 2 * (QUARTER // 2) - 2 * QUARTER) // QUARTER + 1 for side in (height, width))
    return nn.Sequential(first, nn.GroupNorm(GROUPS, widths[0]), nn.ReLU(), *blocks), (widths[-1], height, width)


class _ResNet18(nn.Module):
    """ResNet-18 of ``transformers``, from scratch, with group normalisation."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        from transformers import ResNetConfig, ResNetModel  # seconds of import that the small network does not need

        sizes = [64, 128, 256, 512]
        self.network = ResNetModel(
            ResNetConfig(num_channels=channels, embedding_size=64, hidden_sizes=sizes, depths=[2] * 4, layer_type="basic")
        )
        for module in list(self.network.modules()):
            for name, child in module.named_children():
                if isinstance(child, nn.BatchNorm2d):
                    setattr(module, name, nn.GroupNorm(GROUPS, child.num_features))
        self.network.pooler = nn.Identity()  # type: ignore[assignment]

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.network(x).last_hidden_state
        return out


class ImageEncoder(nn.Module):
    """Features of one image, from scratch: a residual network with group normalisation, and keypoints or the final grid of it.

    Args:
        shape: of the image, ``(channels, height, width)``.
        network: ``'small'``, or ``'resnet18'`` (11 million weights).
        widths: channels of the small network's first convolution and of its residual blocks, multiples of 8; its map is a quarter
            of the image in each direction.
        head: ``'keypoints'`` (spatial softmax), or ``'grid'``, all of the last map, which suits ResNet-18, whose map is small.
        keypoints: how many; of the grid, how many channels.
        crop: pixels by which each side is smaller after cropping: at random in training, in the middle else; 0 for none.
        origin: name of an observed vector, column and row (-1 to 1) of a place in the image, that keypoints are told relative to:
            of a hand, for example, for which it matters where things are from there; empty for the image's middle.

    Raises:
        UserError: for a value that is none.
    """

    def __init__(
        self,
        shape: Sequence[int],
        network: str = "small",
        widths: Sequence[int] = (32,),
        head: str = "keypoints",
        keypoints: int = 32,
        crop: int = 0,
        origin: str = "",
    ) -> None:
        super().__init__()
        for name, value, known in (("network", network, NETWORKS), ("head", head, HEADS)):
            if value not in known:
                raise UserError(f"model.image_encoder.{name}: expected one of {', '.join(known)}, found {value!r}")
        if not widths or any(width < GROUPS or width % GROUPS for width in widths):
            raise UserError(f"model.image_encoder.widths: expected multiples of {GROUPS}, found {list(widths)}")
        if len(shape) != 3 or not 0 < math.prod(shape) <= MOST_PIXELS:
            raise UserError(f"key 'observed': expected images of shape (channels, height, width), found {shown(tuple(shape))}")
        channels, height, width = shape
        expect_range("model.image_encoder.keypoints", keypoints, 1)
        expect_range("model.image_encoder.crop", crop, 0, min(height, width) - 1)
        if origin and head != "keypoints":
            raise UserError(f"model.image_encoder.origin: expected none for a head without keypoints, found {origin!r}")
        self.crop, self.origin = crop, origin
        height, width = height - crop, width - crop
        if network == "small" and min(height, width) < 2 * QUARTER:
            raise UserError(
                f"model.image_encoder.crop: expected images of {2 * QUARTER} x {2 * QUARTER} or more for the small network, "
                f"found {height} x {width}"
            )
        if network == RESNET18:
            self.network: nn.Module = _ResNet18(channels)
            size = (512, -(-height // 32), -(-width // 32))
        else:
            self.network, size = _small(channels, widths, height, width)
        self.head = SpatialSoftmax(size[0], keypoints) if head == "keypoints" else Grid(size[0], keypoints, *size[1:])
        self.size = 3 * keypoints if isinstance(self.head, SpatialSoftmax) else self.head.size
        """Numbers that are read of an image."""

    def forward(self, images: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` uint8 to ``(batch, size)``, keypoints told from the image's middle."""
        height, width = (side - self.crop for side in images.shape[2:])
        if self.crop and self.training:
            top, left = torch.randint(self.crop + 1, (2, len(images), 1), device=images.device)
            rows, columns = (first + torch.arange(side, device=images.device) for first, side in ((top, height), (left, width)))
            every = torch.arange(len(images), device=images.device)[:, None, None]
            images = images[every, :, rows[:, :, None], columns[:, None]].movedim(-1, 1)
        elif self.crop:
            middle = self.crop // 2
            images = images[:, :, middle : middle + height, middle : middle + width]
        out: Tensor = self.head(self.network(images.float() / 127.5 - 1))
        return out


class ImageEncoders(nn.Module):
    """An :class:`ImageEncoder` for each observed image, whose features stand one after another.

    Args:
        observed: features by name, of which the images are encoded.
        arguments: of every encoder.

    Raises:
        UserError: for arguments that it does not take.
    """

    def __init__(self, observed: Mapping[str, Feature], arguments: Mapping[str, Any]) -> None:
        super().__init__()
        self.names = [name for name, feature in observed.items() if feature.kind == "image"]
        encoders = [built(ImageEncoder, arguments, "model.image_encoder", observed[name].shape) for name in self.names]
        self.origins = [encoder.origin for encoder in encoders]
        for origin in self.origins:
            if origin and (origin not in observed or observed[origin].shape != (2,)):
                raise UserError(f"model.image_encoder.origin: expected an observed vector of 2 columns, found {short(origin)!r}")
        self.encoders = nn.ModuleList(encoders)
        self.sizes = [encoder.size for encoder in encoders]
        self.size = sum(self.sizes)
        """Numbers that are read of all images."""

    def forward(self, observed: Observed) -> Tensor:
        """Images by name ``(batch, *shape)`` to ``(batch, size)``."""
        return torch.cat([encoder(observed[name]) for name, encoder in zip(self.names, self.encoders, strict=True)], dim=-1)

    def from_origins(self, read: Tensor, observed: Observed) -> Tensor:
        """The same, keypoints told from their origins.

        Args:
            read: ``(batch, size)``, of images that may have been seen before.
            observed: vectors by name, of which origins are the present ones.
        """
        parts = []
        for part, origin in zip(read.split(self.sizes, dim=1), self.origins, strict=True):
            if origin:
                places, heights = part.split((2 * part.shape[1] // 3, part.shape[1] // 3), dim=1)
                part = torch.cat((places - observed[origin].repeat_interleave(part.shape[1] // 3, dim=1), heights), dim=1)
            parts.append(part)
        return torch.cat(parts, dim=1)
