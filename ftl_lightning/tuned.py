"""The settings that go with a pretrained model, from its domain's configuration of ``invert``."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.errors import UserError
from ftl_lightning.learning.inversion_settings import GROUPS, InversionSettings
from ftl_lightning.trust import is_installed, is_vouched


@dataclass(frozen=True)
class Tuned:
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

        Raises:
            UserError: naming the file, if it is none or a value is not allowed.
        """
        from ftl_lightning.configuration import load  # OmegaConf, which nothing else here needs

        content = load(path, "invert")
        model, data, evaluation = (content.get(key) or {} for key in ("model", "data", "evaluation"))
        options = model.get("init_args") or {}
        learning = {
            field.name: GROUPS[field.name](**options[field.name]) if field.name in GROUPS else options[field.name]
            for field in fields(InversionSettings)
            if field.name in options and field.name != "seed"
        }
        sampling = {field.name: evaluation[field.name] for field in fields(Sampling) if field.name in evaluation}
        try:
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

        Raises:
            UserError: naming the file, if it is none.
        """
        from ftl_lightning.configuration import load

        data = load(path, "invert").get("data") or {}
        domain = (data.get("init_args") or {}).get("domain", "")
        return [domain] if ":" in domain and (is_installed(domain.partition(":")[0]) or is_vouched(domain)) else []
