"""Settings, metrics and published numbers of a domain for reports, which access domains only here."""

import re
from collections.abc import Sequence
from typing import NoReturn

import pandas as pd

from ftl_lightning.domains.domain import CLOSED, COVERAGE, EXECUTED, NOVELTY, Concepts, Domain, Metric, Plans
from ftl_lightning.domains.from_file import OWN
from ftl_lightning.domains.paper import OURS, PAPERS_METHOD, Compared, Published
from ftl_lightning.domains.registry import domain_of_file, is_known
from ftl_lightning.domains.tasks import EvaluationTask
from ftl_lightning.evaluation.judged import LOST, WON
from ftl_lightning.services.errors import UserError, shown
from ftl_lightning.services.text import say

TRAINING, PAPER = "training", "paper"
"""Suites that come first in reports, if a domain has them."""


def domain_of(name: str, rows: pd.DataFrame) -> Domain:
    """The domain of results; for user data or a domain that is not installed, reconstructed from the rows.

    Raises:
        UserError: for a name that cannot be a folder of a report.
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
    """Tasks generated from a single component; they have a separate table."""
    return tuple(task for suite in domain.concepts.suites.values() for task in suite.tasks if task.component is not None)


def settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """Settings with results: training settings, the paper's, then others in order of appearance."""
    apart = {task.setting for task in component_tasks(domain)}
    measured = [setting for setting in dict.fromkeys(rows["setting"]) if setting not in apart]
    order = dict.fromkeys((*training_settings(domain), *_suite(domain, PAPER), *measured))
    return [setting for setting in order if setting in measured]


def learned_settings(domain: Domain, rows: pd.DataFrame) -> list[str]:
    """Settings for the ablations of K and omega: all but training settings."""
    return [setting for setting in settings(domain, rows) if setting not in training_settings(domain)]


def metrics(domain: Domain) -> tuple[str, ...]:
    """Metrics of the comparison: the main metric, success and failures in closed loop, the headline, and the paper's metrics."""
    executed = [EXECUTED, *(f"{CLOSED} {outcome}" for outcome in domain.closed_loop.less_is_better)] if domain.closed_loop else []
    names = dict.fromkeys((domain.main_metric, *executed, domain.headline, *(number.metric for number in published(domain))))
    return tuple(name for name in names if name)


def decisive(domain: Domain, rows: pd.DataFrame) -> str:
    """The metric of a small table: the domain's headline, or its main metric if the rows lack the headline."""
    return domain.headline if domain.headline in set(rows["metric"]) else domain.main_metric


def policies(domain: Domain) -> Sequence[str]:
    """Reference policies that start from the method's initial states."""
    return tuple(domain.closed_loop.policies) if domain.closed_loop else ()


def environments(domain: Domain) -> Sequence[str]:
    """Suffixes of outcomes by environment: empty for the default environment, names in brackets for others."""
    return ("", *(f" ({name})" for name in domain.closed_loop.others)) if domain.closed_loop else ()


def published(domain: Domain) -> tuple[Published, ...]:
    """The paper's numbers, if comparable with ours; otherwise tables have no columns for the paper."""
    return domain.paper.numbers if domain.paper and domain.paper.comparable else ()


def main_omega(domain: Domain) -> str:
    """Guidance weight of our main tables; empty for any measured weight."""
    return domain.paper.ours if domain.paper else ""


def papers_omega(domain: Domain) -> str:
    """Guidance weight of the paper's main figures; empty without a paper."""
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
    """The paper's number, or ``None``.

    Args:
        domain: the domain.
        setting, metric, task: as in a row of the results; without a task the mean of the setting.
        components: K; ignored for baselines.
        omega: guidance weight as text; empty for the weight of the paper's main figures; ignored for baselines.
        method: ours, or a baseline; of our forms, only the paper's has numbers.
    """
    learned = (components, omega or papers_omega(domain))
    for number in published(domain):
        same = (number.setting, number.metric, number.task, Compared(number.method)) == (setting, metric, task, method)
        if same and (method.name != OURS or (number.components, number.omega) == learned):
            return number
    return None


def paper_tasks(domain: Domain, setting: str) -> list[str]:
    """Tasks of a setting with numbers in the paper's main figures."""
    numbers = [number for number in published(domain) if number.setting == setting and number.omega == papers_omega(domain)]
    return [number.task for number in numbers if number.task]


def headlines(domain: Domain, rows: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings and metrics of short tables: those with numbers of the paper, then the same settings in closed loop.

    Without a paper: the first setting of the suite ``paper``, else all settings, each with its decisive metric.
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
