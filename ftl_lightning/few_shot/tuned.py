"""Settings of a pretrained model, from ``invert`` in its domain's configuration."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.igm.settings import GROUPS, InversionSettings
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import shipped
from ftl_lightning.services.trust import is_installed, is_vouched
from ftl_lightning.services.validation import from_mapping


@dataclass(frozen=True)
class ModelSettings:
    """Settings of a model.

    Attributes:
        inversion: settings of the inversion.
        learning_steps: gradient steps.
        sampling: settings of sampling.
        replan: steps between plans in closed loop.
    """

    inversion: InversionSettings
    learning_steps: int
    sampling: Sampling
    replan: int

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a configuration file of ``invert``.

        Args:
            path: path of the file, in the current folder or among shipped files.

        Raises:
            UserError: with the file, if it or a value is invalid.
        """
        from ftl_lightning.services.configuration import load  # needs OmegaConf

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
        """The domain ``module:ATTRIBUTE`` in a configuration file, if its module is installed or trusted.

        A model's folder may then use it.

        Args:
            path: path of the file.

        Raises:
            UserError: with the file, if it is invalid.
        """
        from ftl_lightning.services.configuration import load

        data = load(path, "invert").get("data") or {}
        domain = (data.get("init_args") or {}).get("domain", "")
        return [domain] if ":" in domain and (is_installed(domain.partition(":")[0]) or is_vouched(domain)) else []


OWN = "conf/own.yaml"
"""Default settings for domains without a configuration."""


def settings_of(domain: str, folder: str = "conf") -> str:
    """Configuration file with the settings of ``invert`` for a domain's models.

    Args:
        domain: name of the domain.
        folder: folder of the method's configuration files, such as ``conf/in_context``; empty for none.

    Raises:
        UserError: with the file, if it cannot be read.
    """
    from ftl_lightning.services.configuration import load

    path = f"{folder}/{domain}.yaml"
    if not folder or not shipped(path).is_file():
        return OWN
    model = load(path, "invert").get("model") or {}
    return path if "pretrained" in (model.get("init_args") or {}) else OWN  # otherwise for pretraining alone
