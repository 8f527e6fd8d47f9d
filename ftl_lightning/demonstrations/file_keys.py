"""Names under which files hold demonstrations, the same in safetensors and npz."""

KIND = "demonstrations"
"""What a safetensors file says that it is."""
OBSERVED = "observed/"
"""Before the names of observed features."""
TEXTS = ("state_names", "state_units", "concepts", "per_step")
"""Keys that hold lists of texts."""
