"""Evaluation as a callback: generates every task of a suite in one batch, judges it, and tells TensorBoard and the results file.

It works the same while fitting, in ``validate``, in ``test`` and after ``invert``; all it asks of a module is its generative
model and :class:`Generates`.
"""

import itertools
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torchmetrics import MeanMetric

from ftl_lightning import __version__
from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.diffusion.samplers import SAMPLERS
from ftl_lightning.domains.domain import Domain, EvaluationTask, Policy, Suite, load_domain
from ftl_lightning.errors import UserError
from ftl_lightning.evaluation.closed_loop import Following, Rollout, fixed_plans, planner, roll_out, sampled_plans
from ftl_lightning.evaluation.results import Row, append_rows
from ftl_lightning.evaluation.tensorboard import log_animation, log_hparams, log_projector
from ftl_lightning.learning.generative_model import GenerativeModel
from ftl_lightning.seeding import EVALUATION_SEED, generator
from ftl_lightning.tensor_file import bytes_hash, content_hash, file_hash

SUCCESS = "success"
CLOSED = "closed loop"
WON, LOST = "won against ", "lost against "
"""Metrics of the share of episodes in which only the method succeeds, or only a reference policy from the same initial state."""
OWN = "own demonstrations"
"""The setting of learned concepts that no suite asks for."""


@runtime_checkable
class Generates(Protocol):
    """What an evaluated module offers: the model, names of the method and of learned concepts, and embeddings."""

    model: GenerativeModel
    hparams: Any

    @property
    def method(self) -> str: ...

    @property
    def concepts(self) -> tuple[str, ...]: ...

    def composition(self, task: EvaluationTask) -> tuple[Tensor, Tensor] | None: ...

    def demonstrated(self, concept: str) -> Demonstrations | None: ...

    def concept_embeddings(self) -> dict[str, Tensor]: ...


@dataclass(frozen=True)
class Judged:
    """Generated behaviour of one task.

    Attributes:
        task: what was asked.
        states: plans ``(sample, horizon, state)``.
        right: whether each is right ``(sample,)``, or ``None`` in domains that judge episodes alone.
        initial_states: that they start from ``(sample, m)``, or ``None``.
        rollout: what happened when they were executed, if they were.
        followed: the plan ``(step, horizon, state)`` of each step of the first episode, if they were.
        outcomes: the domain's judgement of that, by name ``(sample,)``.
    """

    task: EvaluationTask
    states: Tensor
    right: Tensor | None
    initial_states: Tensor | None = None
    rollout: Rollout | None = None
    followed: Tensor | None = None
    outcomes: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(cls, task: EvaluationTask, states: Tensor, initial_states: Tensor | None, domain: Domain) -> Self:
        """Judge states by the task's goal."""
        right = domain.succeeded(task.goal, states, initial_states) if domain.succeeded else None
        return cls(task, states, right, initial_states)

    def executed(self, rollout: Rollout, domain: Domain) -> Self:
        """The same with its episodes, judged by the task's goal; one whose plan was not finite is no success."""
        assert domain.closed_loop is not None
        outcomes = domain.closed_loop.judge(self.task.goal, rollout.observations, rollout.infos)
        return replace(self, rollout=rollout, outcomes=outcomes | {SUCCESS: outcomes[SUCCESS] & ~rollout.failed})

    @property
    def values(self) -> dict[str, float]:
        """Every metric's value: ``accuracy`` of plans and, after ``closed loop``, what happened when they were executed."""
        plans = {} if self.right is None else {"accuracy": share(self.right)}
        return plans | {f"{CLOSED} {name}": share(values) for name, values in self.outcomes.items()}


def share(values: Tensor) -> float:
    """Share of true values, or the mean of numbers."""
    metric = MeanMetric()
    metric.update(values.float())
    return float(metric.compute())


def _paired(one: Judged, other: Judged, domain: Domain) -> dict[str, Tensor]:
    """In which episodes ``(sample,)`` one succeeds and another, from the same initial state, does not, and the reverse."""
    assert domain.closed_loop is not None
    ours, theirs = (judged.outcomes[domain.closed_loop.headline] for judged in (one, other))
    return {WON: ours & ~theirs, LOST: theirs & ~ours}


def _public(hparams: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Hyper-parameters without those that Lightning's command line adds for itself."""
    return [(key, value) for key, value in hparams.items() if not key.startswith("_")]


def _key(task: EvaluationTask) -> tuple[int, ...]:
    """What a task adds to a seed."""
    return (zlib.crc32(task.name.encode()), *((1,) if task.initial == "demonstrated" else ()))


def standard_error(values: Sequence[float]) -> float:
    """Standard error of the mean over tasks; 0 for a single one."""
    count = len(values)
    return float(torch.tensor(values).std() / count**0.5) if count > 1 else 0.0


def _executed(judged: Sequence[Judged], policy: Policy, domain: Domain) -> list[Judged]:
    """The same tasks with their episodes, which run all side by side."""
    assert domain.closed_loop is not None
    initial = torch.cat([one.initial_states for one in judged if one.initial_states is not None])
    parts = roll_out(domain.closed_loop, initial, policy).split([len(one.states) for one in judged])
    return [one.executed(part, domain) for one, part in zip(judged, parts, strict=True)]


_ROLLOUTS: dict[tuple[str, str, str, int, str, str], Rollout | None] = {}
"""What reference policies did, by their names and all that it depends on: the cells of an ablation compare with the same."""


def _hash(initial_states: Tensor) -> str:
    return bytes_hash(initial_states.numpy().tobytes())


class Evaluator(pl.Callback):
    """Accuracy of generated behaviour.

    Args:
        suites: names of suites of the domain. Tasks whose concept was not learned are left out; learned concepts that no suite
            asks for are judged by their own name, if the domain can read it.
        samples: generated for each task; the paper's number is 50.
        sampler: ``'ddpm'`` (the paper's), ``'ddim'`` or ``'dpm_solver'``.
        steps: of the sampler, at most the model's T.
        temperature: the paper's alpha.
        closed_loop: also execute plans, in domains that can, when testing (``test``, ``invert``).
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.
        figures: how many samples of a task a TensorBoard figure shows; 0 for no figures.
        results: file to which rows are added when testing (``test``, ``invert``); ``None`` for ``results.csv`` in the log folder.
        seed: of the samples.
    """

    def __init__(
        self,
        suites: Sequence[str] = ("training",),
        samples: int = 50,
        sampler: str = "ddpm",
        steps: int = 100,
        temperature: float = 0.1,
        closed_loop: bool = False,
        replan: int = 8,
        figures: int = 16,
        results: str | None = None,
        seed: int = 0,
    ) -> None:
        if sampler not in SAMPLERS:
            raise UserError(f"evaluation.sampler: expected one of {', '.join(SAMPLERS)}, found {sampler!r}")
        if samples < 1:
            raise UserError(f"evaluation.samples: expected 1 or more, found {samples}")
        if temperature < 0:
            raise UserError(f"evaluation.temperature: expected 0 or more, found {temperature}")
        if replan < 1:
            raise UserError(f"evaluation.replan: expected 1 or more, found {replan}")
        self.suites = tuple(suites)
        # The suites too: the size of a batch decides how its numbers are rounded.
        self.settings: dict[str, Any] = {
            "suites": ", ".join(suites),
            "samples": samples,
            "sampler": sampler,
            "steps": steps,
            "temperature": temperature,
            "sample_seed": seed,
        } | ({"replan": replan} if closed_loop else {})
        self.closed_loop, self.replan = closed_loop, replan
        self.samples, self.sampler, self.steps, self.temperature = samples, SAMPLERS[sampler], steps, temperature
        self.figures = figures
        self.results = results
        self.seed = seed
        self.judged: list[Judged] = []
        self._projected = False

    def _tasks(self, domain: Domain, learned: Sequence[str]) -> list[EvaluationTask]:
        for name in self.suites:
            if name not in domain.suites:
                raise UserError(f"evaluation.suites: expected some of {', '.join(domain.suites)}, found {name!r}")
        tasks = [task for name in self.suites for task in domain.suites[name].tasks]
        asked = {task.learned for task in tasks}
        return tasks + [EvaluationTask(OWN, name, learned=name) for name in learned if name not in asked and domain.reads(name)]

    def _start(self, task: EvaluationTask, module: Generates, domain: Domain) -> Tensor | None:
        """Initial states ``(sample, m)`` of a task, or ``None`` where the domain has none."""
        if domain.initial_states is None:
            return None
        if task.initial == "demonstrated":
            assert task.learned is not None
            own = module.demonstrated(task.learned)
            assert own is not None
            return own.first_initial_states
        return domain.initial_states(task.goal, self.samples, EVALUATION_SEED + self.seed)

    @torch.no_grad()
    def evaluate(self, module: Generates, execute: bool = False) -> list[Judged]:
        """Generate and judge every task, those with equally many samples in one batch of the network.

        Args:
            module: what generates.
            execute: also execute plans in the domain's environment.
        """
        model = module.model
        domain = load_domain(model.config.domain)
        composed = {task: composition for task in self._tasks(domain, module.concepts) if (composition := module.composition(task))}
        starts = {task: self._start(task, module, domain) for task in composed}
        counts = {task: self.samples if start is None else len(start) for task, start in starts.items()}
        judged: dict[EvaluationTask, Judged] = {}
        for count in dict.fromkeys(counts.values()):
            tasks = [task for task in composed if counts[task] == count]
            given = [start for task in tasks if (start := starts[task]) is not None]
            states = model.sample(
                [composed[task][0] for task in tasks],
                [composed[task][1] for task in tasks],
                count,
                self.sampler,
                self.steps,
                self.temperature,
                [generator("cpu", self.seed, *_key(task)) for task in tasks],
                torch.cat(given).to(model.alpha_bar.device) if given else None,
            ).cpu()
            for task, own in zip(tasks, states, strict=True):
                judged[task] = Judged.of(task, own, starts[task], domain)
        found = [judged[task] for task in composed]
        return self._execute(found, composed, model, domain) if execute and domain.closed_loop else found

    def _execute(
        self,
        judged: Sequence[Judged],
        composed: Mapping[EvaluationTask, tuple[Tensor, Tensor]],
        model: GenerativeModel,
        domain: Domain,
    ) -> list[Judged]:
        """With the plans that the model makes on the way."""
        tasks = [one.task for one in judged for _ in one.states]
        draws = [generator("cpu", self.seed, *_key(one.task), episode) for one in judged for episode in range(len(one.states))]
        plan = sampled_plans(
            model,
            [composed[task][0] for task in tasks],
            [composed[task][1] for task in tasks],
            self.sampler,
            self.steps,
            self.temperature,
            draws,
        )
        assert domain.closed_loop is not None
        policy = Following(plan, planner(model, domain.closed_loop), self.replan)
        executed = _executed(judged, policy, domain)
        firsts = itertools.accumulate((len(one.states) for one in judged[:-1]), initial=0)
        return [replace(one, followed=torch.stack(policy.followed[first])) for one, first in zip(executed, firsts, strict=True)]

    def _check(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Tell mistakes before hours of training, not after."""
        if not isinstance(pl_module, Generates):
            raise UserError(f"model.class_path: expected a module that generates behaviour, found {type(pl_module).__name__}")
        total = len(pl_module.model.alpha_bar)
        if not 1 <= self.steps <= total:
            raise UserError(f"evaluation.steps: expected 1 to {total} (the model's T), found {self.steps}")
        self._tasks(load_domain(pl_module.model.config.domain), pl_module.concepts)

    on_fit_start = on_validation_start = on_test_start = _check

    def _run(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        if trainer.sanity_checking:
            return
        assert isinstance(module, Generates)
        self.judged = self.evaluate(module, execute=self.closed_loop and stage == "test")
        domain = load_domain(module.model.config.domain)
        metrics: dict[str, float] = {}
        for setting in Suite(tuple(one.task for one in self.judged)).settings:
            own = [one.values for one in self.judged if one.task.setting == setting]
            for name in own[0]:
                values = [each[name] for each in own]
                metrics[f"{stage}/{name}/{setting}"] = sum(values) / len(values)
                metrics[f"{stage}/standard error{'' if name == 'accuracy' else f' of {name}'}/{setting}"] = standard_error(values)
        each = {
            f"{stage}/{name}/{one.task.setting}/{one.task.name}": value for one in self.judged for name, value in one.values.items()
        }
        module.log_dict(metrics | each, batch_size=1)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                self._draw(logger, domain, trainer.global_step)
                if stage == "test" or not self._projected:  # training embeddings do not change while fitting
                    log_projector(logger, module.concept_embeddings(), trainer.global_step)
                    self._projected = True
                if stage == "test":
                    log_hparams(logger, self._configuration(module, trainer.datamodule), metrics)  # type: ignore[attr-defined]
        if stage == "test" and self.judged:
            path = self.results or Path(trainer.log_dir or trainer.default_root_dir) / "results.csv"
            append_rows(path, self._rows(module, trainer.datamodule))  # type: ignore[attr-defined]
            for name, value in metrics.items():
                print(f"{name.removeprefix('test/')}: {value:.2f}")
            print(f"rows written to {path}")

    def _draw(self, logger: TensorBoardLogger, domain: Domain, step: int) -> None:
        for one in self.judged if self.figures else ():
            shown = slice(0, self.figures)
            start = None if one.initial_states is None else one.initial_states[shown]
            right = None if one.right is None else one.right[shown].tolist()
            title = one.task.name if one.right is None else f"{one.task.name}: {share(one.right):.2f}"
            figure = domain.render(one.states[shown], right, title, start)
            logger.experiment.add_figure(f"{one.task.setting}/{one.task.name}", figure, step)
            if one.rollout is not None and one.followed is not None and domain.closed_loop is not None:
                pictures = domain.closed_loop.frames(one.rollout.observations[0], one.followed)
                log_animation(logger, f"{CLOSED}/{one.task.setting}/{one.task.name}", pictures, step)

    def config_hash(self, module: Generates, data: pl.LightningDataModule) -> str:
        """16 hexadecimal digits that everything configured decides: model, data, evaluation and the pretrained weights."""
        return content_hash([__version__, self._configuration(module, data)])

    def _configuration(self, module: Generates, data: pl.LightningDataModule) -> dict[str, Any]:
        own = data.hparams.get("demonstrations")
        return {
            **{f"model/{key}": value for key, value in _public(module.hparams) if key not in ("pretrained", "output")},
            **{f"data/{key}": value for key, value in _public(data.hparams) if key != "demonstrations"},
            **{f"evaluation/{key}": value for key, value in self.settings.items()},
            "model/pretrained": module.model.hash,
            **({"data/demonstrations": file_hash(own)} if own else {}),
        }

    def _rows(self, module: Generates, data: pl.LightningDataModule) -> list[Row]:
        domain = load_domain(module.model.config.domain)
        hparams = module.hparams
        ours = {
            "method": module.method,
            "K": hparams.get("components", 0),
            "omega": str(hparams.get("omega", hparams.get("guidance"))),
            "model_hash": module.model.hash,
            "config_hash": self.config_hash(module, data),
        }
        nobody = {"K": 0, "omega": "", "model_hash": "", "config_hash": content_hash([__version__, self.samples, self.seed])}

        def rows(one: Judged, what: dict[str, Any]) -> list[Row]:
            subject = {"domain": domain.name, "setting": one.task.setting, "task": one.task.name, "seed": hparams["seed"]}
            return [
                Row(**subject, **what, n=len(one.states), metric=name, value=round(value, 6)) for name, value in one.values.items()
            ]

        referees = self._referees(module, domain)
        references = [row for name, judged in referees.items() for one in judged for row in rows(one, nobody | {"method": name})]
        compared = [
            Row(
                **{"domain": domain.name, "setting": one.task.setting, "task": one.task.name, "seed": hparams["seed"]},
                **ours,
                n=len(one.states),
                metric=f"{what}{name}",
                value=round(share(only), 6),
            )
            for name in (domain.closed_loop.policies if domain.closed_loop else ())
            for other in referees.get(name, ())
            for one in self.judged
            if one.task == other.task
            for what, only in _paired(one, other, domain).items()
        ]
        return [row for one in self.judged for row in rows(one, ours)] + compared + references

    def _referees(self, module: Generates, domain: Domain) -> dict[str, list[Judged]]:
        """What reference policies do on the tasks that were judged, from the same initial states."""
        loop = None if all(one.rollout is None for one in self.judged) else domain.closed_loop
        found = {}
        for name, draw in domain.references.items():
            plans = [draw(one.task.goal, len(one.states), one.initial_states, self.seed) for one in self.judged]
            own = [Judged.of(one.task, states, one.initial_states, domain) for one, states in zip(self.judged, plans, strict=True)]
            if loop is not None:
                own = _executed(own, Following(fixed_plans(torch.cat(plans)), loop.act, loop.steps), domain)
            found[name] = own
        if loop is None:
            return found
        for name, make in loop.policies.items():
            found[name] = []
            for one in self.judged:
                assert one.initial_states is not None
                known = module.demonstrated(one.task.learned) if one.task.learned else None
                key = (name, domain.name, one.task.goal, self.seed, _hash(one.initial_states), known.hash if known else "")
                if key not in _ROLLOUTS:
                    policy = make(one.task.goal, one.initial_states, known, self.seed)
                    _ROLLOUTS[key] = policy and roll_out(loop, one.initial_states, policy)
                if (rollout := _ROLLOUTS[key]) is not None:
                    found[name].append(one.executed(rollout, domain))
        return found

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate while fitting and in ``validate``."""
        self._run(trainer, pl_module, "val")

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate in ``test`` and at the end of ``invert``."""
        self._run(trainer, pl_module, "test")
