"""The table of settings in ``differences.md``, written from the configuration files: ``python docs/settings.py``."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from ftl_lightning.configuration import load
from ftl_lightning.tensor_file import write_text

PAGE = Path(__file__).parent / "differences.md"
BEGIN, END = "<!-- settings: begin, written by docs/settings.py -->\n", "<!-- settings: end -->\n"
DOMAINS = {
    "object_rearrangement": "object rearrangement",
    "agent": "navigation",
    "driving": "driving",
    "mocap": "human motion",
    "tabletop": "table-top",
}
"""Configurations, and what their domains are called."""
DDPM = ("ddpm", 100, 0.1)
"""Sampler, steps and temperature where a configuration does not say."""

Keys = Mapping[str, Any]


def _args(keys: Keys, part: str) -> Keys:
    return keys[part].get("init_args", {})


def _network(fit: Keys, invert: Keys) -> str:
    model = _args(fit, "model")
    sizes, unet = model["denoiser_args"], model.get("denoiser") == "TemporalUNet"
    return f"temporal U-Net, width {sizes['width']}" if unet else f"MLP, {sizes['depth']} x {sizes['hidden_dim']}"


def _pretraining(fit: Keys, invert: Keys) -> str:
    return f"{fit['trainer']['max_steps']:,} x {_args(fit, 'data').get('batch_size', 128)}"


def _concept(fit: Keys, invert: Keys) -> str:
    model = _args(invert, "model")
    parts = [f"K = {model.get('components', 2)}"]
    if model.get("modes", {}).get("sets", 1) != 1:
        parts.append("modes")
    if (knots := model.get("embeddings", {}).get("knots", 1)) != 1:
        parts.append(f"{knots} knots")
    return ", ".join(parts)


def _omega(fit: Keys, invert: Keys) -> str:
    model = _args(invert, "model")
    omega, scale = model.get("omega", 1.2), model.get("weights", {}).get("scale", 1)
    return f"{omega}" + (f", times {scale}" if scale != 1 else "")


def _training_weight(fit: Keys, invert: Keys) -> str:
    model = _args(invert, "model")
    own = model.get("weights", {}).get("training")
    return str(own) if own is not None else "1" if model.get("omega") == "learned" else str(model.get("omega", 1.2))


def _learning(fit: Keys, invert: Keys) -> str:
    model, budget = _args(invert, "model"), _args(invert, "model").get("budget", {})
    modes = model.get("modes", {})
    samples = modes.get("samples", 8) if modes.get("sets", 1) != 1 else budget.get("samples", 32)
    return f"{_args(invert, 'data').get('steps', 400)} x {samples}"


def _demonstrations(fit: Keys, invert: Keys) -> str:
    return str(_args(invert, "data").get("demonstrations_per_concept", 5))


def _sampler(fit: Keys, invert: Keys) -> str:
    evaluation = invert.get("evaluation", {})
    sampler, steps, temperature = (
        evaluation.get(name, usual) for name, usual in zip(("sampler", "steps", "temperature"), DDPM, strict=True)
    )
    return f"{sampler}, {steps} steps, {temperature}"


def _followed(fit: Keys, invert: Keys) -> str:
    evaluation = invert.get("evaluation", {})
    return str(evaluation["replan"]) if evaluation.get("closed_loop") else "-"


ROWS: tuple[tuple[str, Callable[[Keys, Keys], str], str], ...] = (
    ("network", _network, "MLP; temporal U-Net of width 128 in all domains but object rearrangement; ResNet-18 for images"),
    ("pretraining: steps x windows", _pretraining, "not said"),
    ("form of a concept", _concept, "K = 2, one set, alike at all times"),
    ("guidance weight omega", _omega, "1.2; 1.6; learned; 1.6; learned (in this order)"),
    ("weight of a training concept beside a learned one", _training_weight, "omega, or 1 where that is learned"),
    ("learning: steps at most x samples (of each mode)", _learning, "50,000 x 2"),
    ("demonstrations of a new concept", _demonstrations, "5; 5; 5; 3 or 2; 10"),
    ("sampler, steps, temperature", _sampler, "DDPM, as Decision Diffuser"),
    ("closed loop: steps that a plan is followed for", _followed, "1; in table-top 32"),
)
"""What a row is called, what it says of a configuration, and the paper's value."""


def table() -> str:
    """Markdown: a column for each domain, the paper's last."""
    keys = {name: (load(f"conf/{name}.yaml", "fit"), load(f"conf/{name}.yaml", "invert")) for name in DOMAINS}
    lines = [["", *DOMAINS.values(), "the paper"], ["---"] * (len(DOMAINS) + 2)]
    lines += [[name, *(says(*one) for one in keys.values()), papers] for name, says, papers in ROWS]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def written(page: str) -> str:
    """The page with the table of today."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}{table()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    write_text(PAGE, written(PAGE.read_text(encoding="utf-8")))
