"""What an evaluation draws: figures of plans, films of plans and of episodes."""

from collections.abc import Sequence

from lightning.pytorch.loggers import TensorBoardLogger

from ftl_lightning.domains.domain import CLOSED, Domain
from ftl_lightning.evaluation.animation import outcome_text
from ftl_lightning.evaluation.judged import Judged, share
from ftl_lightning.evaluation.tensorboard import log_animation


def draw(logger: TensorBoardLogger, judged: Sequence[Judged], domain: Domain, figures: int, step: int) -> None:
    """Draw each task's plans into TensorBoard, film the first, and its first episode if there is one.

    Args:
        logger: where to.
        judged: what is drawn.
        domain: whose pictures they are.
        figures: how many samples a figure shows, 1 or more.
        step: the trainer's.
    """
    shown = slice(0, figures)
    for behaviour in judged:
        name = f"{behaviour.task.setting}/{behaviour.task.name}"
        start = None if behaviour.starts is None else behaviour.starts.take(shown)
        right = None if behaviour.right is None else behaviour.right[shown].tolist()
        title = behaviour.task.name if behaviour.right is None else f"{behaviour.task.name}: {share(behaviour.right):.2f}"
        logger.experiment.add_figure(name, domain.show.picture(behaviour.states[shown], right, title, start), step)
        if domain.show.film is not None:
            log_animation(logger, f"film/{name}", domain.show.film(behaviour.states[0]), step, title)
        film = domain.closed_loop.film if domain.closed_loop else None
        if film and behaviour.rollout is not None and behaviour.followed is not None:
            pictures = film(behaviour.rollout.take(0, 1), behaviour.followed)
            log_animation(logger, f"{CLOSED}/{name}", pictures, step, behaviour.task.goal, outcome_text(behaviour.outcomes))
