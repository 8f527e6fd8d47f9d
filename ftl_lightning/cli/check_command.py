"""The verb ``check``, with local imports for a fast start."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ftl_lightning.services.printing import line, say

if TYPE_CHECKING:
    from ftl_lightning.data.check import Finding
    from ftl_lightning.data.demonstrations import Demonstrations
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.training.checks import Check


@dataclass(frozen=True)
class CheckOptions:
    """Say whether demonstrations of a concept suffice, and which of them is odd.

    Attributes:
        file: file of demonstrations (.npz or .safetensors), folder of a LeRobot data set, or name of a Minari data set; each of its
            concepts is checked.
        pretrained: folder of the pretrained model to learn with, or the name of a shipped model; empty to check for faults alone.
        learn: also learn each concept from some of its demonstrations and measure the others; needs a model.
        figure: picture to write, .png, .svg or .pdf.
        settings: configuration file of invert with settings of learning; empty for that of the domain.
    """

    file: str
    pretrained: str = ""
    learn: bool = False
    figure: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        from ftl_lightning.services.errors import UserError

        if self.figure and Path(self.figure).suffix not in (".png", ".svg", ".pdf"):
            raise UserError(f"figure: expected a name that ends in .png or .svg or .pdf, found {self.figure!r}")
        if not self.pretrained:
            for name in ("learn", "settings"):
                if getattr(self, name):
                    raise UserError(f"{name}: expected --pretrained MODEL beside it, found no model")


def check(options: CheckOptions) -> None:
    """Check every concept of the file; print and draw the results."""
    from ftl_lightning.data.check import read_mended
    from ftl_lightning.few_shot.learner import FewShot

    demonstrations, broken = read_mended(options.file)
    model = FewShot.from_pretrained(options.pretrained, options.settings or None) if options.pretrained else None
    if model is not None:
        demonstrations = _fitting(model, demonstrations, options.file)
    checks = []
    for text in dict.fromkeys(demonstrations.concepts):
        rows = [row for row, concept in enumerate(demonstrations.concepts) if concept == text]
        faults = tuple(fault.within(rows) for fault in broken if set(fault.rows) <= set(rows))
        checks.append(_checked(model, demonstrations.rows(rows), faults, options.learn))
        for text_line in str(checks[-1]).splitlines():
            say(f"{text_line[: len(text_line) - len(text_line.lstrip())]}{line(text_line)}")
    if options.figure:
        from ftl_lightning.reporting.concept_figures import check_figure
        from ftl_lightning.services.tensor_file import atomic

        with atomic(options.figure) as temporary:
            check_figure(checks).savefig(temporary, dpi=110)
        say(options.figure)


def _fitting(model: "FewShot", demonstrations: "Demonstrations", path: str) -> "Demonstrations":
    from ftl_lightning.services.errors import about

    with about(path):
        return model.demonstrations(demonstrations, name=Path(path).stem)


def _checked(model: "FewShot | None", demonstrations: "Demonstrations", faults: "tuple[Finding, ...]", learn: bool) -> "Check":
    from ftl_lightning.data.check import check as faults_of
    from ftl_lightning.training.checks import Check, check_with

    if model is None:
        return Check(demonstrations.concepts[0], demonstrations, (*faults, *faults_of(demonstrations)))
    steps = model.tuned.learning_steps if learn else 0
    return check_with(model.model, demonstrations, model.tuned.inversion, steps, faults, progress=True)
