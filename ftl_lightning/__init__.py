"""Few-shot task learning through inverse generative modelling (Netanyahu et al., 2024) on PyTorch Lightning."""

# Nothing is imported here but what is asked for: the command line starts without PyTorch, and `python -m ftl_lightning` takes the
# current folder off Python's path before any module could be imported from it.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ftl_lightning.data.demonstrations import Demonstrations
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.igm.composition import Composition
    from ftl_lightning.igm.concept import Concept
    from ftl_lightning.services.shipped import list_models
    from ftl_lightning.version import __version__

__all__ = ["Composition", "Concept", "Demonstrations", "FewShot", "__version__", "list_models"]
_MODULES = {
    "Composition": "igm.composition",
    "Concept": "igm.concept",
    "Demonstrations": "data.demonstrations",
    "FewShot": "few_shot.learner",
    "__version__": "version",
    "list_models": "services.shipped",
}
"""Where each of them is."""


def __getattr__(name: str) -> object:
    """What is offered, imported when it is asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")
    import importlib

    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """What can be imported, before it is."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
