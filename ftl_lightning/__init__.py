"""Few-shot task learning through inverse generative modelling (Netanyahu et al., 2024) on PyTorch Lightning."""

# Nothing is imported here but what is asked for: the command line starts without PyTorch, and `python -m ftl_lightning` takes the
# current folder off Python's path before any module could be found in it.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ftl_lightning.few_shot import FewShot
    from ftl_lightning.version import __version__

__all__ = ["FewShot", "__version__"]


def __getattr__(name: str) -> object:
    """What is offered, imported when it is asked for."""
    if name == "FewShot":
        from ftl_lightning.few_shot import FewShot

        return FewShot
    if name == "__version__":
        from ftl_lightning.version import __version__

        return __version__
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
