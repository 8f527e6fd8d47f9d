"""Pretraining with privileged information: image encoders are trained to predict positions in training demonstrations."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.features import READ, Observed, take
from ftl_lightning.domains.domain import Domain
from ftl_lightning.networks.image_encoder import ImageEncoders
from ftl_lightning.services.errors import UserError, require, short
from ftl_lightning.services.validation import LARGEST_FACTOR, check_range
from ftl_lightning.training.data import Batch


class Teaching:
    """Auxiliary losses of image encodings, and replacement of encodings by privileged information.

    Args:
        weights: loss weights by name, see :class:`~ftl_lightning.domains.domain.Privileged`; empty for none.
        share: share of each step's windows without encoded images.

    Raises:
        UserError: for a weight or share out of its range, or a share with several names or none.
    """

    def __init__(self, weights: Mapping[str, float], share: float) -> None:
        self.weights, self.share = dict(weights), share
        for name, weight in self.weights.items():
            check_range(f"model.privileged.{name}", weight, 0, LARGEST_FACTOR)
        check_range("model.told", share, 0, 1)
        if share == 1 or (share and len(self.weights) != 1):
            raise UserError(f"model.told: expected less than 1, and one name in model.privileged, found {share}")

    def check_taught(self, domain: Domain, images: ImageEncoders | None) -> None:
        """Refuse names that the domain does not provide or the encoder of ``images`` cannot predict."""
        for name in self.weights:
            privileged = domain.recordings.privileged.get(name)
            if privileged is None or images is None:
                names = ", ".join(domain.recordings.privileged) if images is not None else "none, as no image is observed"
                raise UserError(f"model.privileged: expected {names or 'none'} (domain {domain.name}), found {short(name)!r}")
            place, expected = f"model.privileged.{name}", f"image_encoder of {privileged.feature.shape[0]} points"
            require(images.size == privileged.feature.size, place, expected, f"{images.size} outputs")
            possible = not self.share or privileged.simulate is not None
            require(possible, "model.told", f"0, as the domain does not simulate encodings of {name!r}", self.share)

    def attach(self, images: ImageEncoders | None) -> None:
        """Keep the outputs of image encoders."""
        if self.weights and images is not None:
            images.register_forward_hook(self._keep)

    def _keep(self, module: torch.nn.Module, inputs: Any, read: Tensor) -> None:
        self._read = read

    def errors(self, domain: Domain, observed: Observed) -> dict[str, Tensor]:
        """Mean prediction error of the last image encodings, by name."""
        return {name: domain.recordings.privileged[name].error(self._read, observed[name]).mean() for name in self.weights}

    def split(self, domain: Domain, batch: Batch) -> tuple[Batch, Batch | None]:
        """Split a batch into windows with encoded images (not empty) and windows without images."""
        count = max(1, round((1 - self.share) * len(batch.states)))
        if count >= len(batch.states):
            return batch, None
        images = [name for name, feature in domain.observed.items() if feature.kind == "image"]
        vectors = {name: values[count:] for name, values in batch.observed.items() if name not in images}
        first = Batch(batch.states[:count], batch.concepts[:count], take(batch.observed, slice(count)))
        return first, Batch(batch.states[count:], batch.concepts[count:], vectors)

    def simulated(self, domain: Domain, observed: Observed, draw: torch.Generator) -> dict[str, Tensor]:
        """Add simulated image encodings to the observations of windows without images."""
        (name,) = self.weights
        simulate = domain.recordings.privileged[name].simulate
        assert simulate is not None
        return {**observed, READ: simulate(observed[name], draw)}
