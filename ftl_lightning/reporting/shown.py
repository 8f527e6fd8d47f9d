"""What reports show of a domain: the only place of the reports that knows what a domain is made of."""

from collections.abc import Sequence

import pandas as pd

from ftl_lightning.domains.domain import OURS, Domain, EvaluationTask, Published
from ftl_lightning.evaluation.judged import ACCURACY, CLOSED, SUCCESS

EXECUTED = f"{CLOSED} {SUCCESS}"
TRAINING, PAPER = "training", "paper"
"""Suites that come first in reports, in domains that have them."""


def _suite(domain: Domain, name: str) -> tuple[str, ...]:
    return domain.suites[name].settings if name in domain.suites else ()


def training_settings(domain: Domain) -> tuple[str, ...]:
    """The settings of training concepts."""
    return _suite(domain, TRAINING)


def component_tasks(domain: Domain) -> tuple[EvaluationTask, ...]:
    """Tasks that are generated from a single component; they have a table of their own."""
    return tuple(task for suite in domain.suites.values() for task in suite.tasks if task.component is not None)


def settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """The settings that have results: those of training, then the paper's, then others as they appear."""
    apart = {task.setting for task in component_tasks(domain)}
    measured = [setting for setting in dict.fromkeys(rows["setting"]) if setting not in apart]
    order = dict.fromkeys((*training_settings(domain), *_suite(domain, PAPER), *measured))
    return [setting for setting in order if setting in measured]


def learned_settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """The settings that the ablations of K and omega are about: all but those of training concepts."""
    return [setting for setting in settings(domain, rows) if setting not in training_settings(domain)]


def judges_plans(domain: Domain) -> bool:
    """Whether plans are judged, not only what comes of them."""
    return domain.succeeded is not None


def main_metric(domain: Domain) -> str:
    """What ablations are about: plans where they are judged, else episodes."""
    return ACCURACY if judges_plans(domain) else EXECUTED


def headline(domain: Domain) -> str:
    """What methods and policies are compared by, episode for episode; empty without an environment."""
    return f"{CLOSED} {domain.closed_loop.headline}" if domain.closed_loop else ""


def metrics(domain: Domain) -> tuple[str, ...]:
    """What the methods are compared by: the main metric, success in closed loop, the headline, and the paper's."""
    executed = [EXECUTED, headline(domain)] if domain.closed_loop else []
    return tuple(dict.fromkeys((main_metric(domain), *executed, *(one.metric for one in domain.published))))


def less_is_better(domain: Domain, metric: str) -> bool:
    """Whether the metric is a cost."""
    return domain.closed_loop is not None and metric.removeprefix(f"{CLOSED} ") in domain.closed_loop.costs


def policies(domain: Domain) -> Sequence[str]:
    """Reference policies that act from the same initial states as the method."""
    return tuple(domain.closed_loop.policies) if domain.closed_loop else ()


def main_omega(domain: Domain) -> str:
    """The guidance weight of our main tables."""
    return domain.omega


def papers_omega(domain: Domain) -> str:
    """The guidance weight of the paper's main figures; ours where there is no paper."""
    return domain.published_omega if domain.published else domain.omega


def has_paper(domain: Domain) -> bool:
    """Whether there are numbers of a paper to stand beside ours; without any, tables have no columns for them."""
    return bool(domain.published)


def lookup(
    domain: Domain, setting: str, metric: str, task: str = "", components: int = 2, omega: str = "", method: str = OURS
) -> Published | None:
    """The paper's number, if it has one.

    Args:
        domain: the domain.
        setting, metric, task: as in a row of the results; without a task the mean of the setting.
        components: K; of a baseline it does not matter.
        omega: the guidance weight as text; empty for that of the paper's main figures. Of a baseline it does not matter.
        method: ours, or a baseline.
    """
    form = (components, omega or papers_omega(domain))
    for found in domain.published:
        same = (found.setting, found.metric, found.task, found.method) == (setting, metric, task, method)
        if same and (method != OURS or (found.components, found.omega) == form):
            return found
    return None


def paper_tasks(domain: Domain, setting: str) -> list[str]:
    """Tasks of a setting of which the paper's main figures show a number of their own."""
    return [one.task for one in domain.published if one.setting == setting and one.task and one.omega == papers_omega(domain)]


def headlines(domain: Domain, rows: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings and metrics that say most in few lines: those that the paper has numbers of, then the same settings in closed loop.

    Without a paper the main metric of each setting.
    """
    measured = set(zip(rows["setting"], rows["metric"], strict=True))
    every = settings(domain, rows)
    published = {
        (one.setting, one.metric)
        for one in domain.published
        if not one.task and (one.method != OURS or (one.components, one.omega) == (2, papers_omega(domain)))
    }
    if not published:
        return [(setting, main_metric(domain)) for setting in every if (setting, main_metric(domain)) in measured]
    reported = [(setting, metric) for setting in every for metric in metrics(domain) if (setting, metric) in published]
    executed = [(setting, headline(domain)) for setting in dict.fromkeys(setting for setting, _ in reported)]
    return [one for one in dict.fromkeys((*reported, *executed)) if one in measured]
