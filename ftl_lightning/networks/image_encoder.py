"""Image encoders, trained jointly with the rest of the network."""

import itertools
import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ftl_lightning.data.features import Feature, Observed
from ftl_lightning.services.errors import require, shown
from ftl_lightning.services.randomness import drawn
from ftl_lightning.services.validation import check_range, from_mapping

MOST_POINTS = 1000
MOST_PIXELS = 100_000_000
"""Maximum number of values of an image."""
GROUPS = 8
"""Groups of group normalisation. It replaces batch normalisation, whose statistics are not part of an EMA of the weights (Chi et
al., 2023)."""
STRIDES = (2, 4)
RESNET18 = "resnet18"
NETWORKS = ("small", RESNET18)
KEYPOINTS, POINTS, OBJECTS, GRID = HEADS = ("keypoints", "points", "objects", "grid")
OF_OBJECTS = POINTS, OBJECTS  # Heads with a supervised point for each object
HIDDEN = 64  # Width of the readout of objects
POINT = 4
"""Values per point: x, y, height, and the visibility logit."""


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with group normalisation (He et al., 2016), the first with a stride."""

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


def _grid(x: Tensor) -> Tensor:
    """Column and row (-1 to 1) of each pixel of maps ``(batch, channels, height, width)``: ``(height * width, 2)``."""
    height, width = x.shape[2:]
    rows, columns = (torch.linspace(-1, 1, side, device=x.device) for side in (height, width))
    return torch.stack((columns.repeat(height), rows.repeat_interleave(width)), dim=-1)


class SpatialSoftmax(nn.Module):
    """Spatial softmax: position and value of the maximum of each channel (Levine et al., 2016)."""

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.maps = nn.Conv2d(channels, keypoints, 1)

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` to column, row (-1 to 1) and height of each keypoint ``(batch, 3 * keypoints)``."""
        maps = self.maps(x).flatten(2)
        share = maps.softmax(dim=-1)
        column, row = (share @ _grid(x)).unbind(dim=-1)  # a single product: sums over large maps dominate the time
        return torch.cat((column, row, (share * maps).sum(dim=-1).tanh()), dim=-1)


class ObjectAttention(nn.Module):
    """A point for each object, from the features where the object is.

    Each object has ``maps`` spatial softmaxes. The first locates it; the mean features under all of them determine its height,
    visibility and a correction of its position, which perspective scales with the height. A linear readout of the keypoints of all
    objects can confuse an object's height with the presence of others.

    Args:
        channels: channels of the feature map.
        objects: number of objects.
        maps: number of maps of each object.
    """

    def __init__(self, channels: int, objects: int, maps: int) -> None:
        super().__init__()
        self.objects, self.maps = objects, nn.Conv2d(channels, objects * maps, 1)
        self.place = nn.Linear(2, 2, bias=False)
        self.first, self.second = nn.Linear(maps * (2 + channels), HIDDEN), nn.Linear(HIDDEN, POINT + 1)
        self.own = nn.Parameter(torch.zeros(objects, HIDDEN))

    def forward(self, x: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` to all x, y, heights and visibility logits ``(batch, 4 * objects)``."""
        share = self.maps(x).flatten(2).softmax(dim=-1)
        values = torch.cat((_grid(x).expand(len(x), -1, -1), x.flatten(2).transpose(1, 2)), dim=-1)
        read = (share @ values).unflatten(1, (self.objects, -1))
        scale, correction, rest = self.second(functional.relu(self.first(read.flatten(2)) + self.own)).split((1, 2, 2), dim=-1)
        place = self.place(read[:, :, 0, :2]) * (1 + scale) + correction
        return torch.cat((place, rest), dim=-1).transpose(1, 2).flatten(1)


def _small(channels: int, widths: Sequence[int], stride: int, height: int, width: int) -> tuple[nn.Module, tuple[int, int, int]]:
    """Build a residual network and compute the shape of its feature map, which is smaller by ``stride`` in each direction.

    The first convolution does all downsampling: in deeper stems, convolutions at high resolution dominate the time.
    """
    first = nn.Conv2d(channels, widths[0], 2 * stride, stride, padding=stride // 2, bias=False)
    blocks = [ResidualBlock(before, after, 1) for before, after in itertools.pairwise(widths)]
    height, width = ((side + 2 * (stride // 2) - 2 * stride) // stride + 1 for side in (height, width))
    return nn.Sequential(first, nn.GroupNorm(GROUPS, widths[0]), nn.ReLU(), *blocks), (widths[-1], height, width)


class _ResNet18(nn.Module):
    """ResNet-18 of ``transformers``, from scratch, with group normalisation."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        from transformers import ResNetConfig, ResNetModel  # slow import, not needed for the small network

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
    """Image encoder, trained from scratch: a residual network with group normalisation and a head.

    Args:
        shape: image shape ``(channels, height, width)``.
        network: ``'small'``, or ``'resnet18'`` (11 million weights).
        widths: channels of the small network's first convolution and of its residual blocks, multiples of 8.
        stride: stride of the small network's first convolution and so of its feature map, 2 or 4; 2 localises more precisely.
        head: ``'keypoints'`` (spatial softmax), ``'objects'`` (object positions by attention, supervised in pretraining),
            ``'points'`` (the same by a linear readout of keypoints) or ``'grid'`` (the whole last feature map, for the small map
            of ResNet-18).
        keypoints: number of keypoints, of channels of the grid, or of maps of each object.
        points: number of objects, for ``'objects'`` and ``'points'``.
        crop: pixels removed from each side length: random crop in training, centre crop otherwise; 0 for none.
        origin: observed vector with the origin of keypoints (column and row in the image, -1 to 1) or points (x and y), such as
            the position of a hand. Empty for the image centre.

    Raises:
        UserError: for an invalid value.
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
        key = "model.image_encoder"
        for name, value, known in (("network", network, NETWORKS), ("head", head, HEADS), ("stride", stride, STRIDES)):
            require(value in known, f"{key}.{name}", f"one of {', '.join(map(str, known))}", shown(value))
        valid = bool(widths) and all(width >= GROUPS and width % GROUPS == 0 for width in widths)
        require(valid, f"{key}.widths", f"multiples of {GROUPS}", list(widths))
        is_image = len(shape) == 3 and 0 < math.prod(shape) <= MOST_PIXELS
        require(is_image, "key 'observed'", "images of shape (channels, height, width)", tuple(shape))
        channels, height, width = shape
        check_range(f"{key}.keypoints", keypoints, 1)
        check_range(f"{key}.crop", crop, 0, min(height, width) - 1)
        count = "1 or more" if head in OF_OBJECTS else "0"
        require((points > 0) == (head in OF_OBJECTS), f"{key}.points", f"{count} for {head}", points)
        check_range(f"{key}.points", points, 0, MOST_POINTS)
        require(not origin or head != GRID, f"{key}.origin", "none for a head without keypoints", shown(origin))
        self.crop, self.origin = crop, origin
        height, width = height - crop, width - crop
        if network == RESNET18:
            self.network: nn.Module = _ResNet18(channels)
            maps = (512, -(-height // 32), -(-width // 32))
        else:
            least = f"images of {2 * stride} x {2 * stride} or more for the small network"
            require(min(height, width) >= 2 * stride, f"{key}.crop", least, f"{height} x {width}")
            self.network, maps = _small(channels, widths, stride, height, width)
        self.head: nn.Module
        self.values = POINT if head in OF_OBJECTS else 3  # per keypoint or point
        if head == GRID:
            self.head, self.size = nn.Sequential(nn.Conv2d(maps[0], keypoints, 1), nn.Flatten()), keypoints * maps[1] * maps[2]
        elif head == OBJECTS:
            self.head, self.size = ObjectAttention(maps[0], points, keypoints), POINT * points
        elif head == POINTS:
            self.size = POINT * points
            parts = OrderedDict(keypoints=SpatialSoftmax(maps[0], keypoints), read=nn.Linear(3 * keypoints, self.size))
            self.head = nn.Sequential(parts)
        else:
            self.head, self.size = SpatialSoftmax(maps[0], keypoints), 3 * keypoints

    def forward(self, images: Tensor) -> Tensor:
        """``(batch, channels, height, width)`` uint8 to ``(batch, size)``, keypoints relative to the image centre."""
        height, width = (side - self.crop for side in images.shape[2:])
        if self.crop and self.training:
            corners = drawn(len(images), lambda n: torch.randint(self.crop + 1, (2, n, 1), device=images.device).movedim(1, 0))
            top, left = corners.unbind(dim=1)
            rows, columns = (first + torch.arange(side, device=images.device) for first, side in ((top, height), (left, width)))
            batch = torch.arange(len(images), device=images.device)[:, None, None]
            images = images[batch, :, rows[:, :, None], columns[:, None]].movedim(-1, 1)
        elif self.crop:
            middle = self.crop // 2
            images = images[:, :, middle : middle + height, middle : middle + width]
        out: Tensor = self.head(self.network(images.float() / 127.5 - 1))
        return out


class ImageEncoders(nn.Module):
    """Concatenated features of all observed images, each encoded by an :class:`ImageEncoder` with the same arguments.

    Raises:
        UserError: for invalid arguments.
    """

    def __init__(self, observed: Mapping[str, Feature], arguments: Mapping[str, Any]) -> None:
        super().__init__()
        self.names = [name for name, feature in observed.items() if feature.kind == "image"]
        encoders = [from_mapping(ImageEncoder, arguments, "model.image_encoder", observed[name].shape) for name in self.names]
        self.origins = [encoder.origin for encoder in encoders]
        self.values = [encoder.values for encoder in encoders]
        for origin in filter(None, self.origins):
            is_point = origin in observed and observed[origin].shape == (2,)
            require(is_point, "model.image_encoder.origin", "an observed vector of 2 columns", shown(origin))
        self.encoders = nn.ModuleList(encoders)
        self.sizes = [encoder.size for encoder in encoders]
        self.size = sum(self.sizes)

    def forward(self, observed: Observed) -> Tensor:
        """Images by name ``(batch, *shape)`` to ``(batch, size)``."""
        return torch.cat([encoder(observed[name]) for name, encoder in zip(self.names, self.encoders, strict=True)], dim=-1)

    def from_origins(self, encoding: Tensor, observed: Observed) -> Tensor:
        """Shift keypoints in features ``(batch, size)``, possibly of earlier images, to be relative to the current origins."""
        parts = []
        for part, origin, values in zip(encoding.split(self.sizes, dim=1), self.origins, self.values, strict=True):
            if origin:
                count = part.shape[1] // values
                places, rest = part[:, : 2 * count], part[:, 2 * count :]
                part = torch.cat((places - observed[origin].repeat_interleave(count, dim=1), rest), dim=1)
            parts.append(part)
        return torch.cat(parts, dim=1)
