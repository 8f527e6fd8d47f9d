"""Options that stand in groups today and did not in older configuration files and commands, and classes that have moved.

This is the only place that knows how they were called; what is older keeps working and is told in one line.
"""

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ftl_lightning.option_groups import groups_of
from ftl_lightning.printing import say

PRETRAINING: Mapping[str, str] = {
    "condition_dropout": "loss.condition_dropout",
    "loss": "loss.kind",
    "timestep_power": "loss.timestep_power",
    "loss_discount": "loss.discount",
    "code_share": "codes.share",
    "code_knots": "codes.knots",
    "code_size": "codes.size",
    "code_noise": "codes.noise",
    "code_relative": "codes.relative",
}
"""Of our pretraining, where each option is, ``'group.option'``, by its flat name, under which models' records know it."""
INVERSION: Mapping[str, str] = {
    "initial_omega": "weights.initial",
    "off_span": "embeddings.off_span",
    "initial_spread": "embeddings.initial_spread",
    "start": "embeddings.start",
    "restarts": "budget.restarts",
    "screening": "budget.screening",
    "learning_rate": "budget.learning_rate",
    "weight_learning_rate": "weights.learning_rate",
    "samples": "budget.samples",
    "mode_samples": "modes.samples",
    "modes": "modes.sets",
    "tolerance": "budget.tolerance",
    "precision": "budget.precision",
    "knots": "embeddings.knots",
    "guidance_scale": "weights.scale",
    "adapter": "adapter.rank",
    "adapter_learning_rate": "adapter.learning_rate",
    "adapter_scope": "adapter.scope",
    "loss": "loss.kind",
    "timestep_power": "loss.timestep_power",
    "training_omega": "weights.training",
}
"""Of an inversion, where each option is, by its flat name, under which results, checkpoints and the Python API know it."""
_GROUPS = groups_of(PRETRAINING) + groups_of(INVERSION)
_INVERSIONS = (
    "ftl_lightning.learning.InversionModule",
    "ftl_lightning.learning.inversion_module.InversionModule",
    "ftl_lightning.methods.lora.adaptation.FineTuning",
)
_PRETRAININGS = (
    "ftl_lightning.learning.PretrainingModule",
    "ftl_lightning.methods.ftl_igm.pretraining.PretrainingModule",
)
_BASELINES = "ftl_lightning.learning.baselines"
CLASSES: Mapping[str, str] = {
    "ftl_lightning.learning.diffusion_pretraining.PretrainingModule": "ftl_lightning.learning.PretrainingModule",
    f"{_BASELINES}.cloning.CloningPretraining": "ftl_lightning.methods.bc.pretraining.CloningPretraining",
    f"{_BASELINES}.vae.VAEPretraining": "ftl_lightning.methods.cvae.pretraining.VAEPretraining",
    f"{_BASELINES}.in_context.InContextPretraining": "ftl_lightning.methods.in_context.pretraining.InContextPretraining",
    f"{_BASELINES}.prompting.InContextAdaptation": "ftl_lightning.learning.learner_adaptation.LearnerAdaptation",
    f"{_BASELINES}.language.LanguageAdaptation": "ftl_lightning.methods.language.adaptation.LanguageAdaptation",
}
"""Where classes are today that configurations name."""
_EITHER = "learning_rate"
"""An option of both, which an inversion has in a group: only the class tells."""
_PLACES: Mapping[str, str] = {name: place for name, place in {**PRETRAINING, **INVERSION}.items() if name != _EITHER}


def class_of(files: Sequence[Mapping[str, Any]], verb: str) -> str:
    """The class of ``model`` that files which are merged in order configure, as it is called today.

    Args:
        files: their keys.
        verb: ``invert``'s is told where no file names one; empty for none.
    """
    models = [model for keys in files if isinstance(model := keys.get("model"), Mapping)]
    named = [str(model["class_path"]) for model in models if model.get("class_path") is not None]
    path = named[-1] if named else _INVERSIONS[0] if verb == "invert" else ""
    return CLASSES.get(path, path)


def regrouped(keys: Mapping[str, Any], where: str, named: str) -> dict[str, Any]:
    """A configuration file's keys as they are called today; what is older is told in one line.

    Args:
        keys: of the file.
        where: the file.
        named: the class of ``model``, which another file may name.
    """
    found, told = _renamed(keys, named)
    if told:
        _tell(f"note: {where}: {', '.join(told)}")
    return found


def _renamed(keys: Mapping[str, Any], named: str) -> tuple[dict[str, Any], list[str]]:
    """The keys as they are called today, and what is told of each that was older."""
    model = keys.get("model")
    if not isinstance(model, Mapping):
        return dict(keys), []
    renamed, told = dict(model), []
    path = str(model.get("class_path"))
    if path in CLASSES:
        renamed["class_path"] = CLASSES[path]
        told.append(f"{path} is now {CLASSES[path]}")
    places = _places(named)
    options = model.get("init_args")
    if isinstance(options, Mapping):
        renamed["init_args"], names = _grouped(options, places)
        told += [f"model.{name} is now model.{places[name]}" for name in names]
    return {**keys, "model": renamed}, told


def _places(named: str) -> Mapping[str, str]:
    """Where flat options are of a class, of an unknown one those that are the same for both of ours; of others none."""
    if named in _INVERSIONS:
        return INVERSION
    if named in _PRETRAININGS:
        return PRETRAINING
    return {} if named else _PLACES


@functools.cache
def _tell(note: str) -> None:
    """Once in a process, however often a file is read."""
    say(note, error=True)


def _grouped(options: Mapping[str, Any], places: Mapping[str, str]) -> tuple[dict[str, Any], list[str]]:
    """Options with flat ones in their groups, and the names of these."""
    result: dict[str, Any] = {}
    moved = []
    for name, value in options.items():
        group, _, option = places.get(name, "").partition(".")
        if group and not (name == group and isinstance(value, Mapping)):
            result[group] = {**result.get(group, {}), option: value}
            moved.append(name)
        elif isinstance(value, Mapping) and isinstance(result.get(name), Mapping):
            result[name] = {**value, **result[name]}
        else:
            result[name] = value
    return result, moved


_INLINE: Mapping[str, Sequence[str]] = {
    "--config": (),
    "-c": (),
    "--model": ("model",),
    "--model.init_args": ("model", "init_args"),
}
"""Options that may be given several keys at once, with the keys above these."""


def _inline(text: str, above: Sequence[str], named: str) -> tuple[str, list[str]]:
    """Keys that are themselves an argument as they are called today, and what is told of each that was older."""
    from omegaconf import OmegaConf  # which learning and sampling without a command line do not need
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        keys: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (OmegaConfBaseException, YAMLError, ValueError, TypeError):  # told by the parser
        return text, []
    for key in reversed(above):
        keys = {key: keys}
    found: Any
    found, told = _renamed(keys, class_of((keys,), "") or named)
    for key in above:
        found = found[key]
    return (json.dumps(found), told) if told else (text, [])


def _pairs(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Every option with its value, as ``--option=value`` or ``--option value``."""
    for argument, following in zip(arguments, [*arguments, ""][1:], strict=True):
        option, equals, value = argument.partition("=")
        yield option, value if equals else following


def regrouped_arguments(arguments: Sequence[str], verb: str, files: Sequence[Mapping[str, Any]] = ()) -> list[str]:
    """A command line's options of ``model`` as they are called today; what is older is told in one line.

    Args:
        arguments: those of a verb, without it.
        verb: whose class they are of where nothing names one.
        files: keys of the configuration files that the command line names, in order.
    """
    given = [value for option, value in _pairs(arguments) if option in ("--model", "--model.class_path") and "{" not in value]
    named = CLASSES.get(given[-1], given[-1]) if given else class_of(files, verb)
    places = _places(named)
    result, told, rest = [], [], list(arguments)
    while rest:
        argument = rest.pop(0)
        option, equals, value = argument.partition("=")
        if not option.startswith("--model") and option not in _INLINE:
            result.append(argument)
            continue
        if not equals and rest and not rest[0].startswith("--"):
            equals, value = "=", rest.pop(0)
        if option in _INLINE and value.lstrip().startswith("{"):
            value, more = _inline(value, _INLINE[option], named)
            told += more
        name = option.removeprefix("--model.").removeprefix("init_args.")
        if name in places and not value.lstrip().startswith("{"):
            told.append(f"{option} is now --model.{places[name]}")
            option, name = f"--model.{places[name]}", places[name]
        elif name in ("--model", "class_path") and value in CLASSES:
            told.append(f"{value} is now {CLASSES[value]}")
            value = CLASSES[value]
        group, dot, last = name.partition(".")
        if dot and group in _GROUPS and value == "null":  # which the parser takes for a text there
            option, value = f"--model.{group}", f'{{"{last}": null}}'
        result.append(f"{option}{equals}{value}")
    if told:
        _tell(f"note: {', '.join(dict.fromkeys(told))}")
    return result
