"""In-context learning (paper, 'Baselines'; Xu et al., 2022): a transformer prompted with demonstrations."""

from ftl_lightning.training.method import Method

METHOD = Method(
    name="in-context",
    kind="in-context",
    model="ftl_lightning.methods.in_context.model:InContextModel",
    pretraining="ftl_lightning.methods.in_context.pretraining:InContextPretraining",
    adaptation="ftl_lightning.training.learner_adaptation:LearnerAdaptation",
    learner="ftl_lightning.methods.in_context.prompting:prompt",
    configurations="conf/in_context",
    suits="ftl_lightning.training.transitions:check_present",
)
