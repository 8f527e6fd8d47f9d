from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams.backend_context import Context

from ftl_lightning.evaluation.results import Row
from ftl_lightning.evaluation.tensorboard import log_animation, log_projector, log_test, setting_means
from ftl_lightning.igm.concept import Part, Point
from tests.evaluation.rows import REFERENCE
from tests.evaluation.rows import row as usual_row


def row(domain: str, setting: str, task: str, metric: str, value: float, **changes: Any) -> Row:
    return usual_row(domain=domain, setting=setting, task=task, metric=metric, value=value, **changes)


def logger(folder: Path, domain: str) -> TensorBoardLogger:
    return TensorBoardLogger(str(folder), name=f"{domain}/invert", version="")


def test_a_settings_mean_is_over_its_tasks_and_has_the_same_name_in_every_domain() -> None:
    values = [("new", "accuracy", 0.2), ("new", "success", 1.0), ("new", "accuracy", 0.4), ("old", "accuracy", 0.9)]
    assert setting_means(values) == pytest.approx({"accuracy/new": 0.3, "success/new": 1.0, "accuracy/old": 0.9})


def test_the_hparams_tab_shows_all_domains_with_their_metrics_and_tasks(tmp_path: Path) -> None:
    for domain, setting in (("here", "new concept"), ("there", "new initial state")):
        own = logger(tmp_path, domain)
        own.experiment.add_scalar("loss/train", 1.0, 0)
        for value in (0.1, 0.7):  # tested twice: the last counts
            rows = [row(domain, setting, task, "accuracy", value) for task in ("a", "b")]
            rows.append(row(domain, setting, "a", "won against random", 0.3))
            log_test(own, {"domain": domain, "omega": value, "with model/levels": [1, 2]}, rows, 5)
        own.experiment.close()
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(tmp_path)), multiplexer=multiplexer))
    asked = RequestContext()
    content = context.hparams_metadata(asked, "")
    assert set(content) == {"here/invert", "there/invert"}
    experiment = context.experiment_from_metadata(asked, "", True, content, [])
    measured = {"test results/accuracy/new concept", "test results/accuracy/new initial state"}
    assert {info.name.tag for info in experiment.metric_infos} == {"loss/train"} | measured
    found = {info.name: info for info in experiment.hparam_infos}
    assert set(found) == {"domain", "omega", "with model/levels"}
    assert set(found["domain"].domain_discrete) == {"here", "there"}
    assert found["omega"].domain_interval.min_value == found["omega"].domain_interval.max_value == 0.7
    events = EventAccumulator(str(tmp_path / "here" / "invert")).Reload()
    assert [event.value for event in events.Scalars("test results/accuracy/new concept")] == pytest.approx([0.7])


def test_a_test_adds_tables_and_its_means_behind_everything_else(tmp_path: Path) -> None:
    own = logger(tmp_path, "here")
    rows = [row("here", "new", task, "accuracy", value) for task, value in (("a", 0.25), ("b", 0.75))]
    rows += [row("here", "new", "a", "accuracy", 0.1, method="random", **REFERENCE)]
    log_test(own, {}, rows, 5)
    log_animation(own, "3 rollouts/new/a", [np.zeros((20, 60, 3), dtype=np.uint8)] * 2, 5)
    own.experiment.close()
    events = EventAccumulator(str(tmp_path / "here" / "invert")).Reload()
    assert events.Tags()["scalars"] == ["test results/accuracy/new"]
    settings, tasks = (
        events.Tensors(f"test results/{name}/text_summary")[0].tensor_proto.string_val[0].decode() for name in ("settings", "tasks")
    )
    assert "0.50 ± 0.25" in settings
    assert "a (new)" in tasks
    assert "0.75" in tasks
    assert "- random" in tasks
    image = events.Images("3 rollouts/new/a")[0]
    assert image.encoded_image_string.startswith(b"GIF89a")
    assert (image.height, image.width) == (20, 60)


def test_the_projector_tells_text_set_and_component_of_each_point(tmp_path: Path) -> None:
    own, embedding = logger(tmp_path, "here"), torch.zeros(3)
    part = Part(0.5, embedding, 2, mode=1)
    log_projector(own, [Point("a\tb", "training concept", embedding), Point("c", "new component", embedding, part)], 5)
    own.experiment.close()
    table = [row.split("\t") for row in next(tmp_path.rglob("metadata.tsv")).read_text().splitlines()]
    assert table[0] == ["text", "set", "component", "part"]
    assert table[1:] == [["a b", "training concept", "-", "-"], ["c", "new component", "2", "mode 1, component 2"]]
