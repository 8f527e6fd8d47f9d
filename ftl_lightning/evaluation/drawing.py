"""Pictures of an evaluation: figures of demonstrations and plans, films of plans and episodes."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.domains.domain import Domain
from ftl_lightning.domains.pictures import Drawn, beside
from ftl_lightning.evaluation.animation import outcome_text
from ftl_lightning.evaluation.evaluable import demonstrations_of
from ftl_lightning.evaluation.judged import TaskResult, share
from ftl_lightning.evaluation.tensorboard import log_animation
from ftl_lightning.igm.forms.quality import first_windows
from ftl_lightning.training.board import FILMS, PICTURES, ROLLOUTS

if TYPE_CHECKING:  # slow import
    from matplotlib.figure import Figure


def draw(
    logger: TensorBoardLogger,
    judged: Sequence[TaskResult],
    domain: Domain,
    demonstrated: Callable[[str], Demonstrations | None],
    figures: int,
    step: int,
) -> None:
    """Log a figure of each task's plans and films of the first plan and the first episode to TensorBoard.

    Args:
        logger: output.
        judged: generated behaviour.
        domain: domain that draws.
        demonstrated: function from a concept's name to its demonstrations, which are drawn above the plans.
        figures: number of samples in a figure, 1 or more, and maximum number of demonstrations.
        step: global step.
    """
    for behaviour in judged:
        name = f"{behaviour.task.setting}/{behaviour.task.name}"
        logger.experiment.add_figure(f"{PICTURES}/{name}", picture(behaviour, domain, demonstrated, figures), step)
        if domain.show.film is not None:
            log_animation(logger, f"{FILMS}/{name}", domain.show.film(behaviour.states[0]), step, title(behaviour))
        film = domain.closed_loop.film if domain.closed_loop else None
        if film and behaviour.rollout is not None and behaviour.followed is not None:
            pictures = film(behaviour.rollout.take(0, 1), behaviour.followed)
            log_animation(logger, f"{ROLLOUTS}/{name}", pictures, step, behaviour.task.goal, outcome_text(behaviour.outcomes))


def title(behaviour: TaskResult) -> str:
    """Name of the task and share of right plans, if judged."""
    return behaviour.task.name if behaviour.right is None else f"{behaviour.task.name}: {share(behaviour.right):.2f} right"


def picture(behaviour: TaskResult, domain: Domain, demonstrated: Callable[[str], Demonstrations | None], figures: int) -> "Figure":
    """Draw plans, framed green if right and red if wrong, below the demonstrations.

    Args:
        behaviour: behaviour of a task.
        domain: domain that draws.
        demonstrated: function from a concept's name to its demonstrations.
        figures: number of plans, and maximum number of demonstrations.
    """
    shown = slice(0, figures)
    starts = None if behaviour.starts is None else behaviour.starts.take(shown)
    right = None if behaviour.right is None else behaviour.right[shown].tolist()
    states = behaviour.states[shown]
    known = demonstrations_of(behaviour.task, demonstrated)
    if known is None:
        return domain.show.picture(states, right, title(behaviour), starts)
    windows, first = first_windows(known, states.shape[1])
    label = "samples" if right is None else f"samples: {sum(right)} right (green), {right.count(False)} wrong (red)"
    above = Drawn(
        f"demonstrations: {', '.join(behaviour.task.learned)}", windows[shown], first.take(shown) if domain.observed else None
    )
    return beside(domain.show, above, Drawn(label, states, starts, right), title(behaviour))
