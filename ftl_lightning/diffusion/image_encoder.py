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
from ftl_lightning.processes import drawn
from ftl_lightning.ranges import expect_range
from ftl_lightning.schema import from_mapping

MOST_POINTS = 1000
MOST_PIXELS = 100_000_000
"""Numbers of an image."""
GROUPS = 8
"""Of group normalisation, which replaces batch normalisation: that keeps statistics beside the weights, which no running average
of weights holds (Chi et al., 2023)."""
STRIDES = (2, 4)
RESNET18 = "resnet18"
NETWORKS = ("small", RESNET18)
KEYPOINTS, POINTS, GRID = HEADS = ("keypoints", "points", "grid")
POINT = 4
"""Numbers of a point: x, y, height, and the logit of being seen."""


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
        height, width = x.shape[2:]
        rows, columns = (torch.linspace(-1, 1, side, device=x.device) for side in (height, width))
        grid = torch.stack((columns.repeat(height), rows.repeat_interleave(width)), dim=-1)
        maps = self.maps(x).flatten(2)
        share = maps.softmax(dim=-1)
        column, row = (share @ grid).unbind(dim=-1)  # one product: sums over maps of many pixels take most of the time
        return torch.cat((column, row, (share * maps).sum(dim=-1).tanh()), dim=-1)


class Points(nn.Module):
    """Where some things are, told by all keypoints together; what they are, pretraining teaches (``model.privileged``).

    Args:
        channels: of the feature map.
        keypoints: how many are looked at.
        points: how many things there are.
    """

    def __init__(self, channels: int, keypoints: int, points: int) -> None:
        super().__init__()
        self.keypoints = SpatialSoftmax(channels, keypoints)
        self.read = nn.Linear(3 * keypoints, POINT * points)

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` to x, y, height and logit of being seen, all x first: ``(batch, 4 * points)``."""
        out: Tensor = self.read(self.keypoints(x))
        return out


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


def _small(channels: int, widths: Sequence[int], stride: int, height: int, width: int) -> tuple[nn.Module, tuple[int, int, int]]:
    """A residual network whose feature map is smaller by a stride in each direction, and that map's shape.

    The first convolution goes there at once: convolutions of few channels on many pixels take most of the time of deeper stems.
    """
    first = nn.Conv2d(channels, widths[0], 2 * stride, stride, padding=stride // 2, bias=False)
    blocks = [ResidualBlock(before, after, 1) for before, after in itertools.pairwise(widths)]
    height, width = ((side + 2 * (stride // 2) - 2 * stride) // stride + 1 for side in (height, width))
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
        self.network.pooler = nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.network(x).last_hidden_state
        return out


class ImageEncoder(nn.Module):
    """Features of one image, from scratch: a residual network with group normalisation, and keypoints or the final grid of it.

    Args:
        shape: of the image, ``(channels, height, width)``.
        network: ``'small'``, or ``'resnet18'`` (11 million weights).
        widths: channels of the small network's first convolution and of its residual blocks, multiples of 8; its map is a quarter
            of the image in each direction, or what ``stride`` says.
        stride: of the small network's first convolution, 2 or 4; 2 tells places more sharply.
        head: ``'keypoints'`` (spatial softmax), ``'points'``, a few things that pretraining names, or ``'grid'``, all of the last
            map, which suits ResNet-18, whose map is small.
        keypoints: how many; of the grid, how many channels.
        points: how many things are told apart; of ``'points'``.
        crop: pixels by which each side is smaller after cropping: at random in training, in the middle else; 0 for none.
        origin: name of an observed vector, the place that keypoints or points are told relative to: of a hand, for example, for
            which it matters where things are from there. Column and row (-1 to 1) in the image for keypoints, x and y for points.
            Empty for the image's middle.

    Raises:
        UserError: for a value that is none.
    """

    def __init__(
        self,
        shape: Sequence[int],
        network: str = "small",
        widths: Sequence[int] = (32,),
        stride: int = 4,
        head: str = "keypoints",
        keypoints: int = 32,
        points: int = 0,
        crop: int = 0,
        origin: str = "",
    ) -> None:
        super().__init__()
        for name, value, known in (("network", network, NETWORKS), ("head", head, HEADS)):
            if value not in known:
                raise UserError(f"model.image_encoder.{name}: expected one of {', '.join(known)}, found {value!r}")
        if not widths or any(width < GROUPS or width % GROUPS for width in widths):
            raise UserError(f"model.image_encoder.widths: expected multiples of {GROUPS}, found {list(widths)}")
        if stride not in STRIDES:
            raise UserError(f"model.image_encoder.stride: expected one of {', '.join(map(str, STRIDES))}, found {stride!r}")
        if len(shape) != 3 or not 0 < math.prod(shape) <= MOST_PIXELS:
            raise UserError(f"key 'observed': expected images of shape (channels, height, width), found {shown(tuple(shape))}")
        channels, height, width = shape
        expect_range("model.image_encoder.keypoints", keypoints, 1)
        expect_range("model.image_encoder.crop", crop, 0, min(height, width) - 1)
        if (points > 0) != (head == POINTS):
            raise UserError(
                f"model.image_encoder.points: expected {'1 or more' if head == POINTS else 0} for {head}, found {points}"
            )
        expect_range("model.image_encoder.points", points, 0, MOST_POINTS)
        if origin and head == GRID:
            raise UserError(f"model.image_encoder.origin: expected none for a head without keypoints, found {origin!r}")
        self.crop, self.origin = crop, origin
        height, width = height - crop, width - crop
        if network == "small" and min(height, width) < 2 * stride:
            raise UserError(
                f"model.image_encoder.crop: expected images of {2 * stride} x {2 * stride} or more for the small network, "
                f"found {height} x {width}"
            )
        if network == RESNET18:
            self.network: nn.Module = _ResNet18(channels)
            size = (512, -(-height // 32), -(-width // 32))
        else:
            self.network, size = _small(channels, widths, stride, height, width)
        if head == KEYPOINTS:
            self.head: nn.Module = SpatialSoftmax(size[0], keypoints)
            self.size = 3 * keypoints
        elif head == POINTS:
            self.head, self.size = Points(size[0], keypoints, points), POINT * points
        else:
            grid = Grid(size[0], keypoints, *size[1:])
            self.head, self.size = grid, grid.size
        """Numbers that are read of an image."""

    def forward(self, images: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` uint8 to ``(batch, size)``, keypoints told from the image's middle."""
        height, width = (side - self.crop for side in images.shape[2:])
        if self.crop and self.training:
            corners = drawn(len(images), lambda n: torch.randint(self.crop + 1, (2, n, 1), device=images.device).movedim(1, 0))
            top, left = corners.unbind(dim=1)
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
        encoders = [from_mapping(ImageEncoder, arguments, "model.image_encoder", observed[name].shape) for name in self.names]
        self.origins = [encoder.origin for encoder in encoders]
        self.columns = [POINT if isinstance(encoder.head, Points) else 3 for encoder in encoders]
        """Numbers of a keypoint or point."""
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
        for part, origin, columns in zip(read.split(self.sizes, dim=1), self.origins, self.columns, strict=True):
            if origin:
                count = part.shape[1] // columns
                places, rest = part[:, : 2 * count], part[:, 2 * count :]
                part = torch.cat((places - observed[origin].repeat_interleave(count, dim=1), rest), dim=1)
            parts.append(part)
        return torch.cat(parts, dim=1)
