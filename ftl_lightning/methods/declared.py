"""Declarations of the methods: ours, the paper's baselines (section 'Baselines') and fine-tuning.

Each refers to its classes by functions that import them, so that the declarations need no torch.
"""

from typing import Any

from ftl_lightning.domains.comparison import FINE_TUNED, OURS, WITH_ADAPTER, WITH_KNOTS, WITH_MODES
from ftl_lightning.training.method import Form, Method, check_present, check_present_or_moment


def _diffusion_model() -> type[Any]:
    from ftl_lightning.methods.ftl_igm.model import GenerativeModel

    return GenerativeModel


def _diffusion_pretraining() -> type[Any]:
    from ftl_lightning.methods.ftl_igm.pretraining import PretrainingModule

    return PretrainingModule


FTL_IGM = Method(
    name=OURS,
    kind="diffusion",
    model=_diffusion_model,
    pretraining=_diffusion_pretraining,
    forms=(Form(WITH_MODES, "modes", 1), Form(WITH_KNOTS, "knots", 1), Form(WITH_ADAPTER, "adapter", 0)),
    configurations="conf",
)
"""The paper's method: a conditional diffusion model whose concepts are learned by gradient descent."""


def _cloning_model() -> type[Any]:
    from ftl_lightning.methods.bc import CloningModel

    return CloningModel


def _cloning_pretraining() -> type[Any]:
    from ftl_lightning.methods.pretraining import CloningPretraining

    return CloningPretraining


BC = Method(
    name="BC",
    kind="bc",
    model=_cloning_model,
    pretraining=_cloning_pretraining,
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/bc",
    suits=check_present_or_moment,
)
"""Goal-conditioned behaviour cloning."""


def _regression_model() -> type[Any]:
    from ftl_lightning.methods.regression import RegressionModel

    return RegressionModel


def _regression_pretraining() -> type[Any]:
    from ftl_lightning.methods.regression import RegressionPretraining

    return RegressionPretraining


REGRESSION = Method(
    name="BC, our network",
    kind="regression",
    model=_regression_model,
    pretraining=_regression_pretraining,
)
"""Behaviour cloning with the network, the observation and the training of our model."""


def _vae_model() -> type[Any]:
    from ftl_lightning.methods.cvae import VAEModel

    return VAEModel


def _vae_pretraining() -> type[Any]:
    from ftl_lightning.methods.pretraining import VAEPretraining

    return VAEPretraining


CVAE = Method(
    name="CVAE",
    kind="cvae",
    model=_vae_model,
    pretraining=_vae_pretraining,
    forms=(Form(WITH_MODES, "modes", 1),),
    configurations="conf/cvae",
)
"""Conditional VAE."""


def _in_context_model() -> type[Any]:
    from ftl_lightning.methods.in_context import InContextModel

    return InContextModel


def _in_context_pretraining() -> type[Any]:
    from ftl_lightning.methods.pretraining import InContextPretraining

    return InContextPretraining


IN_CONTEXT = Method(
    name="in-context",
    kind="in-context",
    model=_in_context_model,
    pretraining=_in_context_pretraining,
    configurations="conf/in_context",
    suits=check_present,
)
"""In-context learning."""


def _language_adaptation() -> type[Any]:
    from ftl_lightning.methods.adaptation import LanguageAdaptation

    return LanguageAdaptation


LANGUAGE = Method(name="language", kind=FTL_IGM.kind, adaptation=_language_adaptation, configurations="conf")
"""Our model, conditioned on task descriptions (paper, 'Conditioning on Language Descriptions of New Concepts')."""


def _fine_tuning() -> type[Any]:
    from ftl_lightning.methods.adaptation import FineTuning

    return FineTuning


LORA = Method(name=FINE_TUNED, kind=FTL_IGM.kind, adaptation=_fine_tuning, configurations="conf")
"""Fine-tuning our model by a low-rank adapter of all branches (LoRA, Hu et al., 2022)."""
