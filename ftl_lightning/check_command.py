"""The verb ``check``: its options, and what it does. Its imports are inside, so that it starts at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ftl_lightning.printing import line, say

if TYPE_CHECKING:
    from ftl_lightning.demonstrations.container import Demonstrations
    from ftl_lightning.demonstrations.finding import Finding
    from ftl_lightning.few_shot import FewShot
    from ftl_lightning.learning.demonstration_check import Check


@dataclass(frozen=True)
class CheckOptions:
    """Say whether demonstrations of a concept suffice, and which of them is odd.

    Attributes:
        file: of demonstrations (.npz or .safetensors), the folder of a LeRobot data set, or the name of a Minari data set; each of
            its concepts is checked.
        pretrained: folder of the pretrained model that is to learn from them, or the name of one that ships; empty to look for
            faults alone.
        learn: also learn each concept from some of its demonstrations and measure the others; needs a model.
        figure: picture to write, .png, .svg or .pdf.
        settings: configuration file of invert that says how to learn; empty for that of the domain.
    """

    file: str
    pretrained: str = ""
    learn: bool = False
    figure: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        from ftl_lightning.errors import UserError

        if self.figure and Path(self.figure).suffix not in (".png", ".svg", ".pdf"):
            raise UserError(f"figure: expected a name that ends in .png or .svg or .pdf, found {self.figure!r}")
        if not self.pretrained:
            for name in ("learn", "settings"):
                if getattr(self, name):
                    raise UserError(f"{name}: expected --pretrained MODEL beside it, found no model")


def check(options: CheckOptions) -> None:
    """Check every concept of the file, print what was found, and draw it."""
    from ftl_lightning.demonstrations.mended_file import read_mended
    from ftl_lightning.few_shot import FewShot

    demonstrations, broken = read_mended(options.file)
    model = FewShot.from_pretrained(options.pretrained, options.settings or None) if options.pretrained else None
    if model is not None:
        demonstrations = _fitting(model, demonstrations, options.file)
    found = []
    for text in dict.fromkeys(demonstrations.concepts):
        rows = [row for row, own in enumerate(demonstrations.concepts) if own == text]
        faults = tuple(one.within(rows) for one in broken if set(one.rows) <= set(rows))
        found.append(_checked(model, demonstrations.rows(rows), faults, options.learn))
        for told in str(found[-1]).splitlines():
            say(f"{told[: len(told) - len(told.lstrip())]}{line(told)}")
    if options.figure:
        from ftl_lightning.check_figure import picture
        from ftl_lightning.tensor_file import atomic

        with atomic(options.figure) as temporary:
            picture(found).savefig(temporary, dpi=110)
        say(options.figure)


def _fitting(model: "FewShot", demonstrations: "Demonstrations", path: str) -> "Demonstrations":
    from ftl_lightning.errors import about

    with about(path):
        return model.demonstrations(demonstrations, name=Path(path).stem)


def _checked(model: "FewShot | None", demonstrations: "Demonstrations", faults: "tuple[Finding, ...]", learn: bool) -> "Check":
    from ftl_lightning.demonstrations.check import check as faults_of
    from ftl_lightning.learning.demonstration_check import Check, check_with

    if model is None:
        return Check(demonstrations.concepts[0], demonstrations, (*faults, *faults_of(demonstrations)))
    steps = model.tuned.learning_steps if learn else 0
    return check_with(model.model, demonstrations, model.tuned.inversion, steps, faults, progress=True)
