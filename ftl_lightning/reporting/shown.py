"""What reports show of a domain: the only place of the reports that knows what a domain is made of."""

import re
from collections.abc import Sequence
from typing import NoReturn

import pandas as pd

from ftl_lightning.domains.domain import CLOSED, COVERAGE, EXECUTED, NOVELTY, Concepts, Domain, Metric, Plans
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.paper import OURS, PAPERS_METHOD, Compared, Published
from ftl_lightning.domains.registry import domain_of_file, is_known
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.errors import UserError, shown
from ftl_lightning.evaluation.judged import LOST, WON
from ftl_lightning.printing import say

TRAINING, PAPER = "training", "paper"
"""Suites that come first in reports, in domains that have them."""


def domain_of(name: str, rows: pd.DataFrame) -> Domain:
    """The domain that results are about; of one that is not installed, or a user's own data, what the rows tell of it.

    Raises:
        UserError: for a name that no folder of a report can have.
    """
    if not re.fullmatch(r"\w[\w .+-]{0,99}", name):
        raise UserError(
            f"results: column 'domain': expected a name of letters, digits and - . +, found {shown(name)}; mend the row"
        )
    if name != OWN and not is_known(name):
        say(f"domain {name!r} is not installed: its tables are made from the results alone", error=True)
    try:
        return domain_of_file(name)
    except UserError:
        measured = rows.loc[(rows["domain"] == name) & ~rows["metric"].str.startswith((CLOSED, WON, LOST)), "metric"]
        metrics = {metric: Metric(_unknown) for metric in dict.fromkeys(measured) if metric not in (NOVELTY, COVERAGE)}
        concepts = Concepts(training=(), suites={}, descriptions=(), reads=lambda text: False)
        return Domain(name, Plans(0, (), ()), concepts, _unknown, metrics=metrics, headline=next(iter(metrics), EXECUTED))


def _unknown(*arguments: object) -> NoReturn:
    raise UserError("domain: expected an installed one, found one that is known by its results alone; install its package")


def _suite(domain: Domain, name: str) -> tuple[str, ...]:
    return domain.concepts.suites[name].settings if name in domain.concepts.suites else ()


def training_settings(domain: Domain) -> tuple[str, ...]:
    """The settings of training concepts."""
    return _suite(domain, TRAINING)


def component_tasks(domain: Domain) -> tuple[EvaluationTask, ...]:
    """Tasks that are generated from a single component; they have a table of their own."""
    return tuple(task for suite in domain.concepts.suites.values() for task in suite.tasks if task.component is not None)


def settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """The settings that have results: those of training, then the paper's, then others as they appear."""
    apart = {task.setting for task in component_tasks(domain)}
    measured = [setting for setting in dict.fromkeys(rows["setting"]) if setting not in apart]
    order = dict.fromkeys((*training_settings(domain), *_suite(domain, PAPER), *measured))
    return [setting for setting in order if setting in measured]


def learned_settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """The settings that the ablations of K and omega are about: all but those of training concepts."""
    return [setting for setting in settings(domain, rows) if setting not in training_settings(domain)]


def metrics(domain: Domain) -> tuple[str, ...]:
    """What the methods are compared by: the main metric, success in closed loop and what goes wrong there, the headline, and the
    paper's.
    """
    executed = [EXECUTED, *(f"{CLOSED} {outcome}" for outcome in domain.closed_loop.less_is_better)] if domain.closed_loop else []
    names = dict.fromkeys((domain.main_metric, *executed, domain.headline, *(number.metric for number in published(domain))))
    return tuple(name for name in names if name)


def decisive(domain: Domain, rows: pd.DataFrame) -> str:
    """The one metric of a small table: the domain's headline, or its main metric in rows without the headline."""
    return domain.headline if domain.headline in set(rows["metric"]) else domain.main_metric


def policies(domain: Domain) -> Sequence[str]:
    """Reference policies that act from the same initial states as the method."""
    return tuple(domain.closed_loop.policies) if domain.closed_loop else ()


def environments(domain: Domain) -> Sequence[str]:
    """Behind the names of outcomes: nothing in the domain's own environment, the names of its others in these."""
    return ("", *(f" ({name})" for name in domain.closed_loop.others)) if domain.closed_loop else ()


def published(domain: Domain) -> tuple[Published, ...]:
    """The paper's numbers that were measured as ours are; where there are none, tables have no columns for them."""
    return domain.paper.numbers if domain.paper and domain.paper.comparable else ()


def main_omega(domain: Domain) -> str:
    """The guidance weight of our main tables; empty for whatever was measured."""
    return domain.paper.ours if domain.paper else ""


def papers_omega(domain: Domain) -> str:
    """The guidance weight of the paper's main figures; empty where there is no paper."""
    return domain.paper.omega if domain.paper else ""


def lookup(
    domain: Domain,
    setting: str,
    metric: str,
    task: str = "",
    components: int = 2,
    omega: str = "",
    method: Compared = PAPERS_METHOD,
) -> Published | None:
    """The paper's number, if it has one.

    Args:
        domain: the domain.
        setting, metric, task: as in a row of the results; without a task the mean of the setting.
        components: K; of a baseline it does not matter.
        omega: the guidance weight as text; empty for that of the paper's main figures. Of a baseline it does not matter.
        method: ours, or a baseline; the paper has numbers of its own form alone.
    """
    learned = (components, omega or papers_omega(domain))
    for number in published(domain):
        same = (number.setting, number.metric, number.task, Compared(number.method)) == (setting, metric, task, method)
        if same and (method.name != OURS or (number.components, number.omega) == learned):
            return number
    return None


def paper_tasks(domain: Domain, setting: str) -> list[str]:
    """Tasks of a setting of which the paper's main figures show a number of their own."""
    numbers = [number for number in published(domain) if number.setting == setting and number.omega == papers_omega(domain)]
    return [number.task for number in numbers if number.task]


def headlines(domain: Domain, rows: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings and metrics that say most in few lines: those that the paper has numbers of, then the same settings in closed loop.

    Without a paper the first setting of the suite ``paper``, or all where it has none, each with its decisive metric.
    """
    measured = set(zip(rows["setting"], rows["metric"], strict=True))
    measured_settings = settings(domain, rows)
    numbers = {
        (number.setting, number.metric)
        for number in published(domain)
        if not number.task and (number.method != OURS or (number.components, number.omega) == (2, papers_omega(domain)))
    }
    if not numbers:
        papers = [setting for setting in measured_settings if setting in _suite(domain, PAPER)][:1] or measured_settings
        alone = [(setting, decisive(domain, rows[rows["setting"] == setting])) for setting in papers]
        return [headline for headline in alone if headline in measured]
    reported = [(setting, metric) for setting in measured_settings for metric in metrics(domain) if (setting, metric) in numbers]
    executed = [(setting, domain.headline) for setting in dict.fromkeys(setting for setting, _ in reported)]
    return [headline for headline in dict.fromkeys((*reported, *executed)) if headline in measured]
