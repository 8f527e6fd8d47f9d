"""Few-shot task learning through inverse generative modelling (Netanyahu et al., 2024) on PyTorch Lightning."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ftl_lightning.few_shot import FewShot

from ftl_lightning.version import __version__

__all__ = ["FewShot", "__version__"]


def __getattr__(name: str) -> Any:
    """``FewShot``, imported when it is asked for: the command line starts without PyTorch."""
    if name == "FewShot":
        from ftl_lightning.few_shot import FewShot

        return FewShot
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
