"""Evaluation as a callback: generates every task of a suite in one batch, judges it, and tells TensorBoard and the results file.

It works the same while fitting, in ``validate``, in ``test`` and after ``invert``; all it asks of a module is its generative
model and :class:`Evaluable`.
"""

import itertools
import logging
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.concepts.composition import Composition
from ftl_lightning.demonstrations.features import InitialStates, join, moved
from ftl_lightning.diffusion.samplers import Sampling
from ftl_lightning.domains.data import InversionData
from ftl_lightning.domains.domain import CLOSED, Domain
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.errors import UserError, short
from ftl_lightning.evaluation.animation import outcome_text
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, sampled_plans
from ftl_lightning.evaluation.diversity import Real, lines
from ftl_lightning.evaluation.evaluable import Evaluable, demonstrations_of
from ftl_lightning.evaluation.judged import Judged, executed, share
from ftl_lightning.evaluation.references import references
from ftl_lightning.evaluation.results import Row, append_rows
from ftl_lightning.evaluation.rows import config_hash, configuration, rows
from ftl_lightning.evaluation.summary import OWN, show, summary_table
from ftl_lightning.evaluation.tensorboard import log_animation, log_projector, log_test, setting_means
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.printing import say
from ftl_lightning.progress import bar
from ftl_lightning.ranges import MOST_TOGETHER, expect_count, expect_range
from ftl_lightning.seeding import EVALUATION_SEED, generator

_LOG = logging.getLogger(__name__)


def _key(task: EvaluationTask) -> tuple[int, ...]:
    """What a task adds to a seed."""
    return (zlib.crc32(task.name.encode()), *((1,) if task.initial == "demonstrated" else ()))


class Evaluator(pl.Callback):
    """Accuracy of generated behaviour.

    Args:
        suites: names of suites of the domain; ``None`` for the training concepts while fitting, for ``training`` and ``paper`` of
            concepts that a suite asks for, and for none of the user's own demonstrations. Tasks whose concept was not learned are
            left out; learned concepts that no suite asks for are judged by their own name, if the domain can read it.
        samples: generated for each task; the paper's number is 50.
        sampler: ``'ddpm'`` (the paper's), ``'ddim'`` or ``'dpm_solver'``.
        steps: of the sampler, at most the model's T.
        temperature: the paper's alpha.
        closed_loop: also execute plans, in domains that can, when testing (``test``, ``invert``).
        environments: of the domain's others, in which plans are executed besides its own; outcomes there are metrics of their own,
            such as ``closed loop success (step veto)``.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.
        figures: how many samples of a task a TensorBoard figure shows; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        references: also measure reference policies when testing; the same for every method, they are needed once a seed. ``None``
            for all but the user's own demonstrations.
        diversity: also measure novelty and coverage when testing, see :mod:`ftl_lightning.evaluation.diversity`; adds rows and
            changes none.
        variant: what tables tell of this run beside the method's name, in place of the method's own words.
        seed: of the samples.
    """

    def __init__(
        self,
        suites: Sequence[str] | None = None,
        samples: int = 50,
        sampler: str = "ddpm",
        steps: int = 100,
        temperature: float = 0.1,
        closed_loop: bool = False,
        environments: Sequence[str] = (),
        replan: int = 8,
        figures: int = 16,
        results: str | None = None,
        references: bool | None = None,
        diversity: bool = True,
        variant: str | None = None,
        seed: int = 0,
    ) -> None:
        try:
            self.sampling = Sampling(sampler, steps, temperature)
        except UserError as error:
            raise UserError(f"evaluation.{error}") from None
        if samples < 1:
            raise UserError(f"evaluation.samples: expected 1 or more, found {samples}")
        if replan < 1:
            raise UserError(f"evaluation.replan: expected 1 or more, found {replan}")
        expect_count("evaluation.samples", samples, 1, MOST_TOGETHER)
        expect_count("evaluation.replan", replan, 1)
        expect_range("evaluation.seed", seed, 0)
        expect_count("evaluation.figures", figures, 0, 1000)
        self.suites = None if suites is None else tuple(suites)
        self._settings: dict[str, Any] = {
            "samples": samples,
            "sampler": sampler,
            "steps": steps,
            "temperature": temperature,
            "sample_seed": seed,
        } | ({"replan": replan} if closed_loop else {})
        if environments:
            self._settings["environments"] = list(environments)
        self.closed_loop, self.replan = closed_loop, replan
        self.environments = tuple(environments)
        self.samples = samples
        self.figures = figures
        self.results = results
        self.references = references
        self.diversity = diversity
        self.variant = variant
        self.seed = seed
        self.judged: list[Judged] = []
        self.root: Path | None = None
        self.asked = self._asked(None)
        self._projected = False

    def _asked(self, data: object) -> tuple[str, ...]:
        """The suites that are evaluated, given what is learned from."""
        if self.suites is not None:
            return self.suites
        if not isinstance(data, InversionData):
            return ("training",)
        return () if data.own else ("training", "paper")

    def settings(self, data: object) -> dict[str, Any]:
        """What is configured here, given what is learned from."""
        # The suites too: the size of a batch decides how its numbers are rounded.
        return {"suites": ", ".join(self._asked(data)), **self._settings}

    def _tasks(self, domain: Domain, learned: Sequence[str]) -> list[EvaluationTask]:
        suites = domain.concepts.suites
        for name in self.asked:
            if name not in suites:
                raise UserError(f"evaluation.suites: expected some of {', '.join(suites)}, found {name!r}")
        tasks = [task for name in self.asked for task in suites[name].tasks]
        asked = {name for task in tasks for name in task.learned}
        own = [name for name in learned if name not in asked and (domain.concepts.reads(name) or not domain.metrics)]
        return tasks + [EvaluationTask(OWN, name, learned=(name,)) for name in own]

    def _start(self, task: EvaluationTask, module: Evaluable, domain: Domain) -> InitialStates | None:
        """Where a task's behaviour starts, or ``None`` where the domain has no initial states."""
        if not domain.observed:
            return None
        if task.initial == "demonstrated":
            own = module.demonstrated(task.learned[0])
            assert own is not None
            return own.initial_states
        return domain.source(self.root).starts(task.goal, self.samples, EVALUATION_SEED + self.seed)

    @torch.no_grad()
    def evaluate(self, module: Evaluable, execute: bool = False, tasks: Sequence[EvaluationTask] | None = None) -> list[Judged]:
        """Generate and judge every task, those with equally many samples in one batch of the network.

        Args:
            module: what generates.
            execute: also execute plans in the domain's environment.
            tasks: ``None`` for all of the suites.
        """
        model, domain = module.model, module.domain
        asked = self._tasks(domain, module.concepts) if tasks is None else tasks
        composed = {task: composition for task in asked if (composition := module.composition(task))}
        starts = {task: self._start(task, module, domain) for task in composed}
        counts = {task: self.samples if start is None else len(start) for task, start in starts.items()}
        judged: dict[EvaluationTask, Judged] = {}
        for count in dict.fromkeys(counts.values()):
            tasks = [task for task in composed if counts[task] == count]
            given = join([start for task in tasks if (start := starts[task]) is not None])
            states = model.sample(
                [composed[task] for task in tasks],
                count,
                self.sampling,
                [generator("cpu", self.seed, *_key(task)) for task in tasks],
                moved(given.observed, model.device),
            ).cpu()
            for task, own in zip(tasks, states, strict=True):
                judged[task] = Judged.of(task, own, starts[task], domain)
        found = [judged[task] for task in composed]
        return self._execute(found, composed, model, domain) if execute and domain.closed_loop else found

    def _execute(
        self, judged: Sequence[Judged], composed: Mapping[EvaluationTask, Composition], model: ConceptModel, domain: Domain
    ) -> list[Judged]:
        """With the plans that the model makes on the way."""

        def follower() -> PlanFollower:
            assert domain.closed_loop is not None
            tasks = [one.task for one in judged for _ in one.states]
            draws = [generator("cpu", self.seed, *_key(one.task), episode) for one in judged for episode in range(len(one.states))]
            make = sampled_plans(model, [composed[task] for task in tasks], self.sampling, draws)
            return PlanFollower(make, planner(model, domain.closed_loop), self.replan)

        policy = follower()
        done = executed(judged, policy, domain)
        for environment in self.environments:
            done = executed(done, follower(), domain, environment)
        firsts = itertools.accumulate((len(one.states) for one in judged[:-1]), initial=0)
        plans = (policy.followed.get(first) for first in firsts)  # none where the first episode could not begin
        return [replace(one, followed=None if own is None else torch.stack(own)) for one, own in zip(done, plans, strict=True)]

    def real(self, module: Evaluable, judged: Sequence[Judged]) -> list[Real]:
        """The real behaviour that the plans of each task are compared with."""
        found = []
        with bar(f"fresh samples of {len(judged)} tasks", len(judged), lines=False) as advance:
            for one in judged:
                known = demonstrations_of(one.task, module.demonstrated)
                found.append(Real.of(one.task, module.domain, len(one.states), known, self.root, self.seed))
                advance()
        return found

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Tell mistakes before hours of training, not after."""
        if not isinstance(pl_module, Evaluable):
            raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(pl_module).__name__}")
        data = trainer.datamodule  # type: ignore[attr-defined]
        self.asked, self.root = self._asked(data), data.root
        total = pl_module.model.max_steps
        if total is not None and self.sampling.steps > total:
            raise UserError(f"evaluation.steps: expected 1 to {total} (the model's T), found {self.sampling.steps}")
        loop = pl_module.domain.closed_loop
        if self.closed_loop and loop is not None:
            loop.expect()
        others = () if loop is None else tuple(loop.others)
        if unknown := [name for name in self.environments if name not in others]:
            told = f"one of {', '.join(others)}" if others else f"none, as {pl_module.domain.name} has no other"
            raise UserError(f"evaluation.environments: expected {told}, found {short(unknown[0])!r}")
        self._tasks(pl_module.domain, pl_module.concepts)

    on_fit_start = on_validation_start = on_test_start = _check

    def _run(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        if trainer.sanity_checking:
            return
        assert isinstance(module, Evaluable)
        self.judged = self.evaluate(module, execute=self.closed_loop and stage == "test")
        domain, data = module.domain, trainer.datamodule  # type: ignore[attr-defined]
        by_task = {(one.task.setting, one.task.name): one.values for one in self.judged}
        if stage == "val":  # a test is no curve
            module.log_dict({f"val/{name}": value for name, value in setting_means(by_task).items()}, batch_size=1)
        found: list[Row] = []
        configured = configuration(module, data, self.settings(data), trainer)
        if stage == "test" and self.judged:
            compared = self.references if self.references is not None else not getattr(data, "own", False)
            beside = references(self.judged, domain, module.demonstrated, self.seed, self.environments) if compared else {}
            if self.diversity:
                real = self.real(module, self.judged)
                self.judged = [known.added(one) for known, one in zip(real, self.judged, strict=True)]
                beside |= lines(real) if compared else {}
            found = rows(module, domain, self.judged, beside, configured, self.variant)
        if found:  # before anything is drawn, which may fail
            path = self.results or Path(trainer.log_dir or trainer.default_root_dir) / "results.csv"
            append_rows(path, found)
            show(summary_table(found, [row.task for row in found if row.setting == OWN]))
            if self.results is None:
                say(f"{path}: {len(found)} rows")
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                try:
                    self._draw(logger, domain, trainer.global_step)
                except Exception as error:  # whatever a domain's pictures raise: numbers are there already
                    _LOG.warning("domain %s: its pictures cannot be drawn: %r", domain.name, error)
                if stage == "test" or not self._projected:  # training embeddings do not change while fitting
                    log_projector(logger, module.concept_embeddings(), trainer.global_step)
                    self._projected = True
                log_test(logger, configured, found, trainer.global_step)

    def _draw(self, logger: TensorBoardLogger, domain: Domain, step: int) -> None:
        for one in self.judged if self.figures else ():
            shown = slice(0, self.figures)
            start = None if one.starts is None else one.starts.take(shown)
            right = None if one.right is None else one.right[shown].tolist()
            title = one.task.name if one.right is None else f"{one.task.name}: {share(one.right):.2f}"
            figure = domain.show.picture(one.states[shown], right, title, start)
            logger.experiment.add_figure(f"{one.task.setting}/{one.task.name}", figure, step)
            if domain.show.film is not None:
                pictures = domain.show.film(one.states[0])
                log_animation(logger, f"film/{one.task.setting}/{one.task.name}", pictures, step, title)
            film = domain.closed_loop.film if domain.closed_loop else None
            if film and one.rollout is not None and one.followed is not None:
                pictures = film(one.rollout.take(0, 1), one.followed)
                log_animation(
                    logger,
                    f"{CLOSED}/{one.task.setting}/{one.task.name}",
                    pictures,
                    step,
                    outcome_text(one.task.goal, one.outcomes),
                )

    def config_hash(self, module: Evaluable, data: pl.LightningDataModule, trainer: pl.Trainer) -> str:
        """What the results file knows this evaluation by."""
        return config_hash(configuration(module, data, self.settings(data), trainer))

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        self._run(trainer, pl_module, "val")

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        self._run(trainer, pl_module, "test")
