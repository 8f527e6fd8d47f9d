"""The table of settings in ``differences.md``, written from the configuration files: ``python docs/settings.py``."""

import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.services.configuration import load
from ftl_lightning.services.tensor_file import write_text
from ftl_lightning.training.data import InversionData, PretrainingData

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


@dataclass(frozen=True)
class Settings:
    """Of a domain: the keys of ``fit`` and ``invert`` in its configuration, and what they come to with their defaults."""

    fit: Mapping[str, Any]
    invert: Mapping[str, Any]
    tuned: ModelSettings

    @classmethod
    def of(cls, name: str) -> "Settings":
        """Of a configuration ``conf/NAME.yaml``."""
        path = f"conf/{name}.yaml"
        return cls(load(path, "fit"), load(path, "invert"), ModelSettings.read(path))


def _default(function: Callable[..., Any], name: str) -> Any:
    return inspect.signature(function).parameters[name].default


def _args(keys: Mapping[str, Any], part: str) -> Mapping[str, Any]:
    return keys[part].get("init_args", {})


def _network(of: Settings) -> str:
    model = _args(of.fit, "model")
    sizes, unet = model["denoiser_args"], model.get("denoiser") == "TemporalUNet"
    return f"temporal U-Net, width {sizes['width']}" if unet else f"MLP, {sizes['depth']} x {sizes['hidden_dim']}"


def _pretraining(of: Settings) -> str:
    size = _args(of.fit, "data").get("batch_size", _default(PretrainingData.__init__, "batch_size"))
    return f"{of.fit['trainer']['max_steps']:,} x {size}"


def _concept(of: Settings) -> str:
    chosen = of.tuned.inversion
    parts = [f"K = {chosen.components}"]
    if chosen.modes.sets != 1:
        parts.append("modes")
    if chosen.embeddings.knots != 1:
        parts.append(f"{chosen.embeddings.knots} knots")
    return ", ".join(parts)


def _omega(of: Settings) -> str:
    omega, scale = of.tuned.inversion.omega, of.tuned.inversion.weights.scale
    return f"{omega}" + (f", times {scale}" if scale != 1 else "")


def _training_weight(of: Settings) -> str:
    own, omega = of.tuned.inversion.weights.training, of.tuned.inversion.omega
    return f"{own:g}" if own is not None else "1" if omega == "learned" else f"{omega:g}"


def _learning(of: Settings) -> str:
    chosen = of.tuned.inversion
    samples = chosen.modes.samples if chosen.modes.sets != 1 else chosen.budget.samples
    return f"{of.tuned.learning_steps} x {samples}"


def _demonstrations(of: Settings) -> str:
    name = "demonstrations_per_concept"
    return str(_args(of.invert, "data").get(name, _default(InversionData.__init__, name)))


def _sampler(of: Settings) -> str:
    sampling = of.tuned.sampling
    return f"{sampling.sampler}, {sampling.steps} steps, {sampling.temperature}"


def _followed(of: Settings) -> str:
    return str(of.tuned.replan) if of.invert.get("evaluation", {}).get("closed_loop") else "-"


ROWS: tuple[tuple[str, Callable[[Settings], str], str], ...] = (
    ("network", _network, "MLP; temporal U-Net of width 128 in all domains but object rearrangement; ResNet-18 for images"),
    ("pretraining: steps x windows", _pretraining, "a million x 64, object rearrangement 200,000 x 64 (code)"),
    ("form of a concept", _concept, "K = 2, one set, alike at all times"),
    ("guidance weight omega", _omega, "1.2; 1.6; learned; 1.8; learned (in this order)"),
    ("weight of a training concept beside a learned one", _training_weight, "omega, or 1 where that is learned"),
    ("learning: steps at most x samples (of each mode)", _learning, "50,000 x 2 (code)"),
    ("demonstrations of a new concept", _demonstrations, "5; 5; 5; 3 or 2; 10"),
    ("sampler, steps, temperature", _sampler, "DDPM, 100 steps; below 1, in the code 1"),
    ("closed loop: steps that a plan is followed for", _followed, "1; in table-top 32"),
)
"""What a row is called, what it says of a configuration, and the paper's value."""


def table() -> str:
    """Markdown: a column for each domain, the paper's last."""
    domains = [Settings.of(name) for name in DOMAINS]
    lines = [["", *DOMAINS.values(), "the paper"], ["---"] * (len(DOMAINS) + 2)]
    lines += [[name, *(says(one) for one in domains), papers] for name, says, papers in ROWS]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def written(page: str) -> str:
    """The page with the table of today."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}{table()}{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    write_text(PAGE, written(PAGE.read_text(encoding="utf-8")))
