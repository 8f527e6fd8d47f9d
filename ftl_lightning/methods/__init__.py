"""Methods: ours, the paper's baselines (section 'Baselines') and fine-tuning, each declared in a folder of its own.

A declaration (:class:`~ftl_lightning.learning.method.Method`) names everything else lazily, so that it costs nothing to read.
"""
