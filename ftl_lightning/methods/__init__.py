"""Methods: ours, in a folder, the paper's baselines (section 'Baselines') and fine-tuning."""
