"""The version of this package: here alone, but for ``CITATION.cff``, which a test compares."""

__version__ = "0.1.0"
