"""Methods: ours, the paper's baselines (section 'Baselines') and fine-tuning, each in a separate folder.

A declaration (:class:`~ftl_lightning.training.method.Method`) refers to everything else lazily, so its import is fast.
"""
