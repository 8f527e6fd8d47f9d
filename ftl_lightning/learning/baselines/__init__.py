"""The paper's baselines (section 'Baselines'): behaviour cloning, a conditional VAE, in-context learning and language.

Each is pretrained by a module of its own and adapted to new concepts by the same verbs as ours: cloning and the VAE by gradient
descent (:class:`~ftl_lightning.learning.inversion.InversionModule`), the other two without.
"""
