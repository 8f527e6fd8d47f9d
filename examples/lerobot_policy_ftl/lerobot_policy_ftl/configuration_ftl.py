"""Configuration of a policy of type ``ftl``."""

from dataclasses import dataclass
from typing import NoReturn

from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import OBS_STATE

NOT_TRAINED = "ftl: nothing is trained here; a model is pretrained by `python -m ftl_lightning fit`, a concept learned by `invert`"


@PreTrainedConfig.register_subclass("ftl")
@dataclass
class FtlConfig(PreTrainedConfig):
    """Configuration of a policy: a model, a concept, and how its plans are followed.

    Attributes:
        model: folder of a pretrained model, relative to the policy's folder if it is there.
        concept: text of a training concept, or file of a learned concept, which ends in ``.safetensors``.
        execute: number of steps between plans.
        steps: number of the sampler's steps; ``None`` for the model's.
        seed: seed of the noise of the first episode; each later one has the next.
    """

    model: str = ""
    concept: str = ""
    execute: int = 8
    steps: int | None = None
    seed: int = 0

    def validate_features(self) -> None:
        """Check what the policy needs.

        Raises:
            ValueError: without a model or a concept, or if the inputs have no present state.
        """
        for name, what in (("model", "the folder of a pretrained model"), ("concept", "a text or the file of a learned concept")):
            if not getattr(self, name):
                raise ValueError(f"policy.{name}: expected {what}, found none")
        if self.input_features and OBS_STATE not in self.input_features:
            raise ValueError(f"policy.input_features: expected {OBS_STATE!r}, found {', '.join(self.input_features)}")

    def get_optimizer_preset(self) -> NoReturn:
        """Refuse to train."""
        raise NotImplementedError(NOT_TRAINED)

    def get_scheduler_preset(self) -> None:
        """None, as nothing is trained."""

    @property
    def observation_delta_indices(self) -> None:
        """None: a policy observes the present."""

    @property
    def action_delta_indices(self) -> None:
        """None, as nothing is trained."""

    @property
    def reward_delta_indices(self) -> None:
        """None, as nothing is trained."""
