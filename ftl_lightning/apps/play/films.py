"""Films as JSON for the page: shapes, or bodies in space."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ftl_lightning.data.container import Demonstrations
from ftl_lightning.data.features import InitialStates
from ftl_lightning.domains.domain import SUCCESS, Domain, Show
from ftl_lightning.domains.line_plots import line_film
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.vector_film import VectorFilm
from ftl_lightning.evaluation.pictures import packed, packed_space

Json = dict[str, Any]


def film(drawn: VectorFilm, right: bool | None = None, told: str = "") -> Json:
    """A film of shapes.

    Args:
        drawn: shapes of the film.
        right: whether the behaviour is correct; ``None`` if not judged.
        told: outcome in words.
    """
    window = [round(edge, 4) for edge in drawn.window]
    return {
        "frames": drawn.frames,
        "rate": round(drawn.rate, 3),
        "window": window,
        "shapes": packed(drawn),
        "right": right,
        "told": told,
    }


def plan_film(show: Show, states: Tensor, starts: InitialStates | None, right: bool | None = None) -> Json:
    """The film of a plan or demonstration.

    Args:
        show: the domain's pictures.
        states: ``(time, state)``, finite.
        starts: a single initial state; ``None`` in domains without initial states.
        right: whether the plan is correct; ``None`` if not judged.
    """
    if show.wireframe is not None:
        body = show.wireframe(states)
        return {"space": packed_space(body), "frames": len(body.points), "rate": body.rate, "right": right, "told": ""}
    return film((show.vector_film or line_film)(states, starts), right)


def films(domain: Domain, plans: Demonstrations, right: Sequence[bool] | None = None) -> list[Json]:
    """Films of all demonstrations or samples with finite states."""
    starts, observed = plans.initial_states, bool(domain.observed)
    return [
        plan_film(
            domain.show,
            plans.states[row, :length],
            starts.take([row]) if observed else None,
            None if right is None else bool(right[row]),
        )
        for row, length in enumerate(plans.lengths.tolist())
        if plans.states[row].isfinite().all()
    ]


def episode_films(domain: Domain, rollout: Rollout, outcomes: Mapping[str, Tensor]) -> list[Json]:
    """Films of executed episodes; empty in domains that do not draw them.

    Args:
        domain: domain with an environment.
        rollout: executed episodes.
        outcomes: of each episode by name, of bool or numbers ``(episode,)``; empty if not judged.
    """
    draw = None if domain.closed_loop is None else domain.closed_loop.vector_film
    if draw is None:
        return []
    succeeded = outcomes.get(SUCCESS)
    return [
        film(
            draw(rollout.take(number, number + 1)),
            None if succeeded is None else bool(succeeded[number]),
            _ended(outcomes, number),
        )
        for number in range(len(rollout.failed))
    ]


def _ended(outcomes: Mapping[str, Tensor], number: int) -> str:
    """True outcomes of an episode, in words."""
    judged = {name: bool(values[number]) for name, values in outcomes.items() if values.dtype == torch.bool}
    return ", ".join(name for name, true in judged.items() if true) or (f"no {SUCCESS}" if SUCCESS in judged else "")
