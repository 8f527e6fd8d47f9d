"""The verb ``invert`` with a model and a file, without a trainer; local imports for a fast start."""

import warnings
from dataclasses import dataclass
from pathlib import Path

from ftl_lightning.services.printing import line, say
from ftl_lightning.services.ranges import LARGEST_STEP, check_count, check_range


@dataclass(frozen=True)
class InvertOptions:
    """Learn the concepts of a file of demonstrations through a pretrained model, without a trainer.

    The concepts equal those of "invert --config" for the same file, with the settings of the model's domain. Nothing is
    logged or evaluated.

    Attributes:
        pretrained: folder of the pretrained model, or the name of a shipped model.
        demonstrations: file of demonstrations (.npz or .safetensors), folder of a LeRobot data set, or name of a Minari data set;
            each of its concepts is learned; demonstrations without a text are one concept named after the file.
        out: folder to write, a file for each concept.
        steps: gradient steps; 0 for those of the settings.
        seed: seed of starts, noise and timesteps.
        form: form of the concepts, such as "paper" or "modes"; empty to select it by leave-one-out error.
        settings: configuration file of invert with settings of learning; empty for that of the domain.
    """

    pretrained: str
    demonstrations: str
    out: str = "concepts"
    steps: int = 0
    seed: int = 0
    form: str = ""
    settings: str = ""

    def __post_init__(self) -> None:
        check_count("steps", self.steps, 0, LARGEST_STEP)
        check_range("seed", self.seed, 0)


def invert(options: InvertOptions) -> None:
    """Learn the concepts of the file together and write each."""
    from ftl_lightning.domains.from_file import read_own
    from ftl_lightning.few_shot.learner import FewShot
    from ftl_lightning.igm.library import concept_files, write_concept
    from ftl_lightning.services.errors import about

    model = FewShot.from_pretrained(options.pretrained, options.settings or None)
    demos = read_own(options.demonstrations)
    with about(options.demonstrations):
        demos = model.demonstrations(demos)
    files = concept_files(demos.concepts, Path(options.out), "out")
    changes = {"form": options.form} if options.form else {}
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", UserWarning)
        learned = model.learn_all(demos, steps=options.steps or None, seed=options.seed, progress=True, **changes)
    for note in notes:
        say("note:", line(str(note.message)), error=True)
    for name, path in files.items():
        write_concept(learned[name].concept, path)
