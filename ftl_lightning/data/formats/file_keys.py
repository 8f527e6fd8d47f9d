"""Keys of demonstrations in files, the same in safetensors and npz."""

KIND = "demonstrations"
"""Kind of a safetensors file of demonstrations."""
OBSERVED = "observed/"
"""Prefix of observed features."""
TEXTS = ("state_names", "state_units", "concepts", "per_step")
"""Keys of lists of texts."""
