"""LightningModules of pretraining (Eq. 1) and inversion (Eq. 2), data, trainer, and the folder of a pretrained model."""
