"""Films as the page takes them: JSON of shapes, or of bodies in space."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.demonstrations.features import InitialStates
from ftl_lightning.domains.domain import Domain, Show
from ftl_lightning.domains.line_plots import line_film
from ftl_lightning.domains.rollout import Rollout
from ftl_lightning.domains.vector_film import VectorFilm, of_wireframe
from ftl_lightning.evaluation.films import packed, packed_space

Json = Mapping[str, Any]


def film(drawn: VectorFilm, right: bool | None = None, told: str = "") -> Json:
    """A film of shapes.

    Args:
        drawn: its shapes.
        right: whether what it shows is; ``None`` where nobody judged.
        told: how it ended, in words.
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
        starts: where it starts, one; ``None`` in domains without initial states.
        right: whether it is; ``None`` where nobody judged.
    """
    if show.wireframe is not None:
        body = show.wireframe(states)
        flat = of_wireframe(body)  # for those who draw no space
        return film(flat, right) | {"space": packed_space(body)}
    return film((show.vector_film or line_film)(states, starts), right)


def films(domain: Domain, plans: Demonstrations, right: Sequence[bool] | None = None) -> list[Json]:
    """Those of all demonstrations or samples; what is not finite has none."""
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
    """Those of executed episodes, in domains that draw them.

    Args:
        domain: with an environment.
        rollout: what happened.
        outcomes: of each episode by name, of bool or numbers ``(episode,)``; empty where nobody judged.
    """
    loop, found = domain.closed_loop, []
    draw = None if loop is None else loop.vector_film
    for number in range(len(rollout.failed) if draw else 0):
        told = ", ".join(name for name, values in outcomes.items() if values[number].dtype.is_floating_point is False and values[number])
        right = bool(outcomes["success"][number]) if "success" in outcomes else None
        assert draw is not None
        found.append(film(draw(rollout.take(number, number + 1)), right, told))
    return found
