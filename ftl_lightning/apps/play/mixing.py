"""Films as JSON for the page: demonstrations, and samples of mixed concepts, judged if the domain has metrics."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.apps.play.requests import Sample
from ftl_lightning.apps.play.same import Sampled
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.data.outline import Outline
from ftl_lightning.domains.domain import SUCCESS, Domain
from ftl_lightning.domains.execution import Rollout
from ftl_lightning.domains.films import VectorFilm, still
from ftl_lightning.domains.from_file import FileSource
from ftl_lightning.domains.pictures import WRONG, Show, line_film
from ftl_lightning.evaluation.pictures import packed, packed_space
from ftl_lightning.few_shot.learner import FewShot
from ftl_lightning.igm.composition import Composition
from ftl_lightning.services.errors import UserError, short
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.quality import judging_domain, right_plans

Json = dict[str, Any]
Marks = Sequence[Sequence[Tensor]]  # wrong parts (point, 2) of each sample
RED_LINE = 0.04  # width of the line of a wrong part, relative to the width of a film
STEPS = 10  # maximum number of sampling steps, so that a moving slider is answered at once
PARTS = "parts"  # name of the judgement that no part of a path is missing
JOINED = " and "  # separator of the names of mixed concepts, for domains that read the result as a goal


def sampling_of(model: FewShot, temperature: float | None = None) -> dict[str, Any]:
    """Settings of interactive sampling: the tuned sampler if it takes few steps, else a fast one."""
    tuned = model.tuned.sampling
    sampler, steps = (tuned.sampler, tuned.steps) if tuned.steps <= STEPS else ("dpm_solver", STEPS)
    return {"sampler": sampler, "steps": steps, "temperature": tuned.temperature if temperature is None else temperature}


def starts_of(model: FewShot, tasks: Sequence[str], count: int, seed: int) -> tuple[str, InitialStates | None]:
    """Task and initial states, of the first task that the domain reads; empty without observations. Raise UserError if there is no
    such task.
    """
    if not model.domain.observed:
        return "", None
    for task in (*filter(None, tasks), *model.training_concepts):
        if model.domain.concepts.reads(task):
            return task, model.starts(task, count, seed)
    raise UserError(f"task: expected a goal of {model.domain.name}, found {short(', '.join(tasks))!r}")


def verdicts(model: ConceptModel) -> tuple[str, str]:
    """Words for samples that are right, and for others. Samples of a user's data are only compared with demonstrations."""
    return ("right", "wrong") if model.examples is None else ("alike", "different")


def goal_of(domain: Domain, names: Sequence[str], task: str) -> str:
    """Goal by which a mixture is judged: the joined names if the domain reads them, else the requested task; empty for none."""
    reads = domain.concepts.reads
    return next((text for text in (JOINED.join(names), task) if text and reads(text)), "")


def judge_of(model: FewShot, examples: Sequence[Demonstrations]) -> Domain:
    """Domain that judges samples; for user data, by demonstrations of training and new concepts."""
    base = model.model.examples
    return judging_domain(model.model, [*([] if base is None else [base]), *examples])


@functools.lru_cache(maxsize=2)
def _outline(model: ConceptModel) -> Outline | None:
    """Judge of the parts of paths of a user's data; ``None`` for a shipped domain."""
    return None if model.examples is None else Outline(model.examples, model.horizon, model.places)


def _parts(model: ConceptModel, domain: Domain, plans: Demonstrations, goal: str) -> tuple[Tensor, Marks] | None:
    """Whether no part of each sample is missing or added ``(sample,)``, and these parts if a film shows them: plans of two columns.
    ``None`` for a shipped domain.
    """
    outline = _outline(model)
    if outline is None:
        return None
    source = domain.source(None)
    assert isinstance(source, FileSource)
    compared = plans.states, plans.initial_states.observed, source.demonstrations.select(goal)
    if (whole := outline.whole(*compared)) is None:
        return None
    shown = plans.states.shape[2] == 2 and bool(plans.states.isfinite().all())
    parts = outline.faults(*compared) if shown else [[] for _ in range(len(plans))]
    return whole, [[] if fine else part for fine, part in zip(whole.tolist(), parts, strict=True)]


def judged(model: ConceptModel, domain: Domain, plans: Demonstrations, goal: str) -> tuple[list[Json], str]:
    """Films of samples, and the fraction of correct samples in words; empty without a goal, or if not judged. Samples of a user's
    data are also compared with the demonstrations part by part.
    """
    success, marks = right_plans(domain.measure(goal, plans.states, plans.initial_states)) if goal else None, None
    if goal and (parts := _parts(model, domain, plans, goal)) is not None:
        whole, marks = parts
        success = (PARTS, whole) if success is None else (f"{success[0]}, {PARTS}", success[1] & whole)
    if success is None:
        return films(domain, plans), ""
    name, right = success
    word = verdicts(model)[0]
    verdict = f"{float(right.float().mean()):.0%} of {len(right)} samples {word} ({name.replace('_', ' ')}: {goal})"
    return films(domain, plans, right.tolist(), marks), verdict


def samples(
    model: FewShot, mixed: Composition, names: Sequence[str], examples: Sequence[Demonstrations], asked: Sample, task: str
) -> tuple[list[Json], str, Sampled]:
    """Generate samples of concepts ``mixed``, or episodes that execute them: films, the judgement in words, and the settings of
    sampling. ``names`` are those of the concepts, ``examples`` the demonstrations of those learned here. Initial states are of the
    first of the asked task, ``task`` and ``names`` that the domain reads. Raise UserError for a task that it does not read, or if
    behaviour cannot be executed.
    """
    judge = judge_of(model, examples)
    if asked.task:
        judge.check_goal(asked.task, "task")
    how = sampling_of(model, asked.temperature)
    task, starts = starts_of(model, (asked.task, task, *names), asked.count, asked.seed)
    goal = goal_of(judge, names, asked.task)
    if not asked.execute:
        plans = model.sample(mixed, asked.count, starts, seed=asked.seed, **how)
        played, verdict = judged(model.model, judge, plans, goal)
    elif starts is None:
        raise UserError(f"execute: expected a model whose behaviour is executed, found {model.domain.name}")
    else:
        done = model.execute(mixed, starts, goal, seed=asked.seed, **how)
        outcomes: Mapping[str, Tensor] = model.domain.judge(goal, done.rollout) if goal else {}
        played = episode_films(model.domain, done.rollout, outcomes)
        verdict = ", ".join(f"{name} {value:.2f}" for name, value in done.outcomes.items())
        verdict = f"mean of {asked.count}: {verdict} ({goal})" if verdict else ""
    return played, verdict, Sampled(count=asked.count, seed=asked.seed, task=task, execute=asked.execute, **how)


def film(drawn: VectorFilm, right: bool | None = None, outcome: str = "") -> Json:
    """Film of shapes; ``right`` is ``None`` if not judged."""
    window = [round(edge, 4) for edge in drawn.window]
    shown = {"frames": drawn.frames, "rate": round(drawn.rate, 3), "window": window, "shapes": packed(drawn)}
    return {**shown, "scale": drawn.scale, "right": right, "told": outcome}


def plan_film(
    show: Show, states: Tensor, starts: InitialStates | None, right: bool | None = None, marks: Sequence[Tensor] = ()
) -> Json:
    """Film of a plan or demonstration ``(time, state)``, with a single initial state in domains that have any, and wrong parts
    ``(point, 2)`` in the film's unit.
    """
    if show.wireframe is not None:
        body = show.wireframe(states)
        return {"space": packed_space(body), "frames": len(body.points), "rate": body.rate, "right": right, "told": ""}
    drawn = (show.vector_film or line_film)(states, starts)
    wrong = [still("line", part.numpy().astype(np.float32), WRONG, RED_LINE * drawn.window[2]) for part in marks]
    return film(replace(drawn, shapes=(*drawn.shapes, *wrong)), right)


def films(domain: Domain, plans: Demonstrations, right: Sequence[bool] | None = None, marks: Marks | None = None) -> list[Json]:
    """Films of all demonstrations or samples with finite states, with wrong parts."""
    starts, observed = plans.initial_states, bool(domain.observed)
    return [
        plan_film(
            domain.show,
            plans.states[row, :length],
            starts.take([row]) if observed else None,
            None if right is None else bool(right[row]),
            marks[row] if marks else (),
        )
        for row, length in enumerate(plans.lengths.tolist())
        if plans.states[row].isfinite().all()
    ]


def episode_films(domain: Domain, rollout: Rollout, outcomes: Mapping[str, Tensor]) -> list[Json]:
    """Films of executed episodes with their outcomes ``(episode,)`` by name; empty in domains that do not draw them."""
    draw = None if domain.closed_loop is None else domain.closed_loop.vector_film
    if draw is None:
        return []
    succeeded = outcomes.get(SUCCESS)
    booleans = {name: values for name, values in outcomes.items() if values.dtype == torch.bool}
    episodes = []
    for episode in range(len(rollout.failed)):
        words = ", ".join(name for name, values in booleans.items() if values[episode])
        words = words or (f"no {SUCCESS}" if SUCCESS in booleans else "")
        right = None if succeeded is None else bool(succeeded[episode])
        episodes.append(film(draw(rollout.take(episode, episode + 1)), right, words))
    return episodes
