"""The settings that go with a pretrained model: those of ``invert`` in its domain's configuration."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.errors import UserError
from ftl_lightning.learning.inversion_settings import GROUPS, InversionSettings
from ftl_lightning.schema import from_mapping
from ftl_lightning.shipped import shipped
from ftl_lightning.trust import is_installed, is_vouched


@dataclass(frozen=True)
class ModelSettings:
    """The settings that go with a model.

    Attributes:
        inversion: how concepts are learned.
        learning_steps: of gradient descent.
        sampling: how behaviour is generated.
        replan: steps that a plan is followed in closed loop before a new one is made.
    """

    inversion: InversionSettings
    learning_steps: int
    sampling: Sampling
    replan: int

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """From a configuration file of ``invert``.

        Args:
            path: of the file, in the current folder or among those that ship.

        Raises:
            UserError: naming the file, if it is none or a value is not allowed.
        """
        from ftl_lightning.configuration import load  # OmegaConf, which nothing else here needs

        content = load(path, "invert")
        model, data, evaluation = (content.get(key) or {} for key in ("model", "data", "evaluation"))
        options = model.get("init_args") or {}
        sampling = {field.name: evaluation[field.name] for field in fields(Sampling) if field.name in evaluation}
        try:
            learning = {
                field.name: from_mapping(kind, options[field.name], f"model.{field.name}") if kind else options[field.name]
                for field in fields(InversionSettings)
                if field.name in options and field.name != "seed"
                for kind in [GROUPS.get(field.name)]
            }
            return cls(
                inversion=InversionSettings(**learning),
                learning_steps=int((data.get("init_args") or {}).get("steps", 400)),
                sampling=Sampling(**sampling),
                replan=int(evaluation.get("replan", 1)),
            )
        except UserError as error:
            raise UserError(f"{path}: {error}") from None

    @staticmethod
    def domains(path: str | Path) -> list[str]:
        """The domain ``module:ATTRIBUTE`` that a configuration file names, if its module is installed or a person vouches for it.

        A model's folder may ask for the same one.

        Args:
            path: of the file.

        Raises:
            UserError: naming the file, if it is none.
        """
        from ftl_lightning.configuration import load

        data = load(path, "invert").get("data") or {}
        domain = (data.get("init_args") or {}).get("domain", "")
        return [domain] if ":" in domain and (is_installed(domain.partition(":")[0]) or is_vouched(domain)) else []


OWN = "conf/own.yaml"
"""The settings where a domain has none."""


def settings_of(domain: str, folder: str = "conf") -> str:
    """The configuration file with the settings of ``invert`` that go with a domain's models.

    Args:
        domain: its name.
        folder: of the configuration files of the models' method, such as ``conf/in_context``; empty for none.

    Raises:
        UserError: naming the file, if it cannot be read.
    """
    from ftl_lightning.configuration import load

    path = f"{folder}/{domain}.yaml"
    if not folder or not shipped(path).is_file():
        return OWN
    model = load(path, "invert").get("model") or {}
    return path if "pretrained" in (model.get("init_args") or {}) else OWN  # else it is for pretraining alone
