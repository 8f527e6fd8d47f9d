"""Pictures of what committed concepts generate, as the paper's appendix shows them: ``docs/gallery``.

    python docs/gallery.py [DOMAIN ...]

Each line is one concept (or one component, or a concept composed with a training concept): the first samples of seed 0, green
where the task holds and red where it does not. Nothing is chosen.
"""

import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))  # the package of this checkout, whatever is installed

from matplotlib.figure import Figure
from PIL import Image

from ftl_lightning.domains.films import some
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition

ROOT = Path(__file__).parent.parent
FOLDER = Path(__file__).parent / "gallery"
SAMPLES, FEWER, SEED, WIDTH = 8, {"mocap": 2}, 0, 900
"""Samples of a line, fewer where each is a strip of its own, their seed, and the width of a picture in pixels."""
DOMAINS = ("object_rearrangement", "agent", "driving", "mocap", "tabletop")
SUITES, MOST = ("training", "paper", "composition"), 8
"""Whose settings are shown, and at most so many tasks of each."""
Line = tuple[Composition, str, str]
"""A concept, what is asked of it, and what stands above its samples."""


def learned(model: FewShot, folder: Path) -> dict[str, Composition]:
    """Committed concepts by name."""
    found = [model.load(path) for path in sorted(folder.glob("*.safetensors"))]
    return {one.concept.origin.name: one for one in found}


def picture(model: FewShot, lines: Sequence[Line], path: Path) -> None:
    """Samples of each line, one below the other."""
    drawn, count = [], FEWER.get(model.domain.name, SAMPLES)
    for concept, goal, title in lines:
        observed = model.starts(goal, count, SEED) if model.domain.observed else None
        plans = model.sample(concept, count, observed=observed, seed=SEED)
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


def composed(model: FewShot, known: Mapping[str, Composition], task: EvaluationTask) -> Composition:
    """What a task is generated from: a learned concept, training concepts, or both."""
    weight = model.tuned.inversion.weights.training or 1.0
    parts = [known[name] for name in task.learned] + [(weight if task.learned else 1.0) * model[text] for text in task.texts]
    whole = parts[0]
    for part in parts[1:]:
        whole = whole + part
    return whole


def settings(name: str) -> None:
    """A picture of each of the domain's settings: of training concepts some evenly, of the paper's all tasks."""
    model = FewShot.from_pretrained(name)
    known = learned(model, ROOT / "results" / "concepts" / name / "seed0")
    suites = [model.domain.concepts.suites[suite] for suite in SUITES if suite in model.domain.concepts.suites]
    by_setting: dict[str, list[EvaluationTask]] = {}
    for task in (task for suite in suites for task in suite.tasks):
        if task.initial == "new" and not task.on and set(task.learned) <= set(known):
            by_setting.setdefault(task.setting, []).append(task)
    for setting, found in by_setting.items():
        shown = [found[place] for place in some(len(found), MOST)]
        lines = [(composed(model, known, task), task.goal, task.name) for task in shown]
        picture(model, lines, FOLDER / f"{name}_{setting.replace(' + ', '_').replace(' ', '_')}.png")


def components() -> None:
    """Figure 12: what each component of two learned compositions generates alone."""
    model = FewShot.from_pretrained("object_rearrangement")
    known = learned(model, ROOT / "results" / "concepts" / "object_rearrangement" / "seed0")
    parts: list[Line] = []
    for name in ("circle right of triangle and triangle right of square", "square right of circle and triangle above circle"):
        whole = known[name]
        for number in range(len(whole.weights)):
            alone = Composition(whole.embeddings[number : number + 1], whole.weights[number : number + 1])
            parts.append((alone, name, f"{name}: component {number + 1} alone"))
    picture(model, parts, FOLDER / "object_rearrangement_components.png")


if __name__ == "__main__":
    for name in sys.argv[1:] or DOMAINS:
        settings(name)
        if name == "object_rearrangement":
            components()
