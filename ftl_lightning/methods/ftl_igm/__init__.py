"""Our method (the paper's FTL-IGM): a conditional diffusion model whose concepts are learned by gradient descent."""

from ftl_lightning.domains.comparison import OURS, WITH_ADAPTER, WITH_KNOTS, WITH_MODES
from ftl_lightning.training.method import Form, Method

METHOD = Method(
    name=OURS,
    kind="diffusion",
    model="ftl_lightning.methods.ftl_igm.model:GenerativeModel",
    pretraining="ftl_lightning.methods.ftl_igm.pretraining:PretrainingModule",
    forms=(Form(WITH_MODES, "modes", 1), Form(WITH_KNOTS, "knots", 1), Form(WITH_ADAPTER, "adapter", 0)),
    configurations="conf",
)
