"""Policy of type ``ftl``: a concept's plans, followed by :class:`ftl_lightning.evaluation.policy.Policy`."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, Self

import torch
from huggingface_hub import snapshot_download
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_IMAGES, OBS_PREFIX
from torch import Tensor, nn

from ftl_lightning import Composition, FewShot
from ftl_lightning.few_shot.learned_concept import LearnedConcept
from lerobot_policy_ftl.configuration_ftl import NOT_TRAINED, FtlConfig
from lerobot_policy_ftl.processor_ftl import make_ftl_pre_post_processors

MODEL, CONCEPT = "model", "concept.safetensors"
"""Folder of the model and file of a learned concept in the folder of a saved policy."""
STATE = "state"


class FtlPolicy(PreTrainedPolicy):
    """Policy of a concept, for a batch of environments in lockstep.

    Args:
        config: configuration.
        folder: folder of the policy, if it was saved.
        unused: statistics and description of a data set, which LeRobot gives.

    Raises:
        ValueError: without a model or a concept.
        UserError: for a model that cannot be loaded or has no such concept.
    """

    config_class = FtlConfig
    name = "ftl"

    def __init__(self, config: FtlConfig, *, folder: str | Path = "", **unused: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: FtlConfig = config
        inside, concept = Path(folder) / config.model, config.concept
        self._few_shot = FewShot.from_pretrained(inside if inside.is_dir() else config.model, device=config.device or "cpu")
        self._concept: Composition
        if concept.endswith(".safetensors"):
            saved = Path(folder) / concept
            self._concept = self._few_shot.load(saved if saved.is_file() else concept)
        else:
            self._concept = self._few_shot[concept]
        steps: dict[str, Any] = {} if config.steps is None else {"steps": config.steps}
        self._policy = self._few_shot.policy(self._concept, config.execute, seed=config.seed, **steps)
        self._seed = config.seed
        self.model: nn.Module = self._few_shot.model

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        revision: str | None = None,
        **options: Any,
    ) -> Self:
        """Load a saved policy, from a folder or from the Hub; numbers and texts alone are read."""
        folder = Path(pretrained_name_or_path)
        if not folder.is_dir():
            kinds = ["*.json", "*.safetensors"]
            folder = Path(snapshot_download(str(pretrained_name_or_path), revision=revision, allow_patterns=kinds))
        return cls(config or PreTrainedConfig.from_pretrained(folder), folder=folder).eval()

    def _save_pretrained(self, save_directory: Path) -> None:
        """Write a folder that holds everything: configuration, model, learned concept, and processors."""
        self._few_shot.save_pretrained(save_directory / MODEL)
        config = replace(self.config, model=MODEL)
        if isinstance(self._concept, LearnedConcept):
            self._concept.save(save_directory / CONCEPT)
            config = replace(config, concept=CONCEPT)
        config.save_pretrained(save_directory)
        for processors in make_ftl_pre_post_processors(config):
            processors.save_pretrained(save_directory)

    def reset(self) -> None:
        """Begin new episodes, with new noise."""
        self._policy.reset(self._seed)
        self._seed += 1

    def select_action(self, batch: dict[str, Any], **unused: Any) -> Tensor:
        """Actions ``(episode, action)`` for observations ``(episode, ...)``."""
        return torch.from_numpy(self._policy.act(self._observation(batch))).to(self._few_shot.device)

    def _observation(self, batch: dict[str, Any]) -> Any:
        """What the model observes: features by name, or the state alone, which may hold columns that the model observes."""
        features, seen = self._few_shot.domain.observed, {}
        for key, value in batch.items():
            name = key.removeprefix(f"{OBS_IMAGES}.").removeprefix(OBS_PREFIX)
            if not key.startswith(OBS_PREFIX) or name not in (STATE, *features):
                continue
            if name in features and features[name].kind == "image" and value.is_floating_point():
                value = (255 * value).round().to(torch.uint8)
            seen[name] = value.cpu().numpy()
        return seen[STATE] if seen.keys() == {STATE} else seen

    def predict_action_chunk(self, batch: dict[str, Any], **unused: Any) -> NoReturn:
        """Refuse: each action follows from the present state and the plan."""
        raise NotImplementedError("ftl: an action depends on the state at its time, so there is no chunk; call select_action")

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> NoReturn:
        """Refuse to train."""
        raise NotImplementedError(NOT_TRAINED)

    def get_optim_params(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of the model, which are frozen."""
        return {"params": list(self.parameters())}
