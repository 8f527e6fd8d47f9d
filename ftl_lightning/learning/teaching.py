"""Pretraining with privileged information: encoders of images are taught what is where in training demonstrations."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import READ, Observed, take
from ftl_lightning.diffusion.image_encoder import ImageEncoders
from ftl_lightning.domains.data import Batch
from ftl_lightning.domains.domain import Domain
from ftl_lightning.errors import UserError, short
from ftl_lightning.ranges import LARGEST_FACTOR, expect_range


class Teaching:
    """What is read of images has to tell, and what stands for images that are not looked at.

    Args:
        weights: of errors by name, see :class:`~ftl_lightning.domains.domain.Privileged`; empty to teach nothing.
        share: of each step's windows whose images are not looked at.

    Raises:
        UserError: for a weight or share out of its range, or a share without exactly one name.
    """

    def __init__(self, weights: Mapping[str, float], share: float) -> None:
        self.weights, self.share = dict(weights), share
        for name, weight in self.weights.items():
            expect_range(f"model.privileged.{name}", weight, 0, LARGEST_FACTOR)
        expect_range("model.told", share, 0, 1)
        if share == 1 or (share and len(self.weights) != 1):
            raise UserError(f"model.told: expected less than 1, and one name in model.privileged, found {share}")

    def expect_taught(self, domain: Domain, images: ImageEncoders | None) -> None:
        """Refuse to teach images what the domain does not show, or what no encoder of points reads."""
        for name in self.weights:
            known = domain.privileged.get(name)
            if known is None or images is None:
                told = ", ".join(domain.privileged) if images is not None else "none, as no image is observed"
                raise UserError(f"model.privileged: expected {told or 'none'} (domain {domain.name}), found {short(name)!r}")
            if images.size != known.feature.size:
                raise UserError(
                    f"model.privileged.{name}: expected image_encoder of {known.feature.shape[0]} points, "
                    f"found one that reads {images.size} numbers"
                )
            if self.share and known.told is None:
                raise UserError(f"model.told: expected 0, as nothing tells what is read of {name!r}, found {self.share}")

    def attach(self, images: ImageEncoders | None) -> None:
        """Remember what encoders read, from now on."""
        if self.weights and images is not None:
            images.register_forward_hook(self._keep)

    def _keep(self, module: torch.nn.Module, inputs: Any, read: Tensor) -> None:
        self._read = read

    def errors(self, domain: Domain, observed: Observed) -> dict[str, Tensor]:
        """By name, how badly what was read last tells what the images show: the mean over samples."""
        return {name: domain.privileged[name].error(self._read, observed[name]).mean() for name in self.weights}

    def apart(self, domain: Domain, batch: Batch) -> tuple[Batch, Batch | None]:
        """The windows of a step whose images are looked at, one at least, and the others, without their images."""
        count = max(1, round((1 - self.share) * len(batch.states)))
        if count >= len(batch.states):
            return batch, None
        images = [name for name, feature in domain.observed.items() if feature.kind == "image"]
        unseen = {name: values[count:] for name, values in batch.observed.items() if name not in images}
        first = Batch(batch.states[:count], batch.concepts[:count], take(batch.observed, slice(count)))
        return first, Batch(batch.states[count:], batch.concepts[count:], unseen)

    def told(self, domain: Domain, observed: Observed, draw: torch.Generator) -> dict[str, Tensor]:
        """What is observed of windows without images, with what an encoder might read of them."""
        (name,) = self.weights
        tell = domain.privileged[name].told
        assert tell is not None
        return {**observed, READ: tell(observed[name], draw)}
