"""Pictures of what committed concepts generate, as the paper's appendix shows them: ``docs/gallery``.

    python docs/gallery.py

Each line is one concept (or one component, or a concept composed with a training concept): the first eight samples of seed 0, green
where the task holds and red where it does not. Nothing is chosen.
"""

import io
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from matplotlib.figure import Figure
from PIL import Image

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.few_shot import FewShot

ROOT = Path(__file__).parent.parent
FOLDER = Path(__file__).parent / "gallery"
SAMPLES, SEED, WIDTH = 8, 0, 900
"""Samples of a line, their seed, and the width of a picture in pixels."""
Line = tuple[Composition, str, str]
"""A concept, what is asked of it, and what stands above its samples."""


def tasks(domain: Domain, setting: str) -> list[EvaluationTask]:
    """The paper's tasks of a setting."""
    return [task for task in domain.concepts.suites["paper"].tasks if task.setting == setting]


def learned(model: FewShot, folder: Path) -> dict[str, Composition]:
    """Committed concepts by name."""
    found = [model.load(path) for path in sorted(folder.glob("*.safetensors"))]
    return {one.concept.origin.name: one for one in found}


def picture(model: FewShot, lines: Sequence[Line], path: Path) -> None:
    """Samples of each line, one below the other."""
    drawn = []
    for concept, goal, title in lines:
        observed = model.starts(goal, SAMPLES, SEED) if model.domain.observed else None
        plans = model.sample(concept, SAMPLES, observed=observed, seed=SEED)
        figure = model.render(plans, goal)
        figure.suptitle(title, fontsize=9)
        drawn.append(_image(figure))
    width = max(image.width for image in drawn)
    whole = Image.new("RGB", (width, sum(image.height for image in drawn)), "white")
    top = 0
    for image in drawn:
        whole.paste(image, (0, top))
        top += image.height
    path.parent.mkdir(exist_ok=True)
    whole.resize((WIDTH, round(whole.height * WIDTH / width)), Image.Resampling.LANCZOS).quantize(64).save(path, optimize=True)


def _image(figure: Figure) -> Image.Image:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=100)
    return Image.open(drawn).convert("RGB")


def relations() -> None:
    """Figures 12, 14, 15 and 16: object rearrangement."""
    model = FewShot.from_pretrained("object_rearrangement")
    known = learned(model, ROOT / "results" / "concepts" / "object_rearrangement" / "seed0")
    weight = model.tuned.inversion.weights.training or 1.0
    for setting, name in (
        ("training composition", "compositions"),
        ("new concept", "new_concepts"),
        ("new + training", "composed"),
    ):
        lines: list[Line] = []
        for task in tasks(model.domain, setting):
            (own,) = task.learned
            concept = known[own]
            for text in task.texts:
                concept = concept + weight * model[text]
            lines.append((concept, task.goal, task.goal))
        picture(model, lines, FOLDER / f"relations_{name}.png")
    parts: list[Line] = []
    for name in ("circle right of triangle and triangle right of square", "square right of circle and triangle above circle"):
        whole = known[name]
        for number in range(len(whole.weights)):
            alone = Composition(whole.embeddings[number : number + 1], whole.weights[number : number + 1])
            parts.append((alone, name, f"{name}: component {number + 1} alone"))
    picture(model, parts, FOLDER / "relations_components.png")


def targets() -> None:
    """Navigation: each learned target from new initial states."""
    model = FewShot.from_pretrained("agent")
    known = learned(model, ROOT / "results" / "concepts" / "agent" / "seed0")
    picture(model, [(concept, name, name) for name, concept in known.items()], FOLDER / "navigation.png")


if __name__ == "__main__":
    relations()
    targets()
