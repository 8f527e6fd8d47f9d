"""Configuration files: parts, sections, their order, mistakes in them, and what is shipped."""

import copy
import functools
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ftl_lightning.few_shot.tuned import settings_of
from ftl_lightning.services.command_line import Arguments
from ftl_lightning.services.configuration import SECTIONS, _read, find, load, parts
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.shipped import shipped
from tests.conftest import CONF, ROOT
from tests.test_cli import CONFIGS

PARTS = ("verb.yaml", "domain", "sampling", "method")
"""What configurations are built from."""


def write(path: str, text: str) -> str:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)
    return path


def test_later_parts_win_and_a_file_wins_over_its_parts() -> None:
    write("a.yaml", "model: {x: 1, y: 1, z: 1}\nlist: [1, 2, 3]\n")
    write("b.yaml", "model: {y: 2, z: 2}\n")
    write("c.yaml", "defaults: [a.yaml, b.yaml]\nmodel: {z: 3}\nlist: [4]\nseed: ${other}\n")
    assert load("c.yaml") == {"model": {"x": 1, "y": 2, "z": 3}, "list": [4], "seed": "${other}"}
    assert [path.name for path, _ in parts("c.yaml")] == ["a.yaml", "b.yaml", "c.yaml"]


def test_a_part_is_looked_for_beside_the_file_then_above_it_then_among_the_shipped_ones(tmp_path: Path) -> None:
    write("parts/a.yaml", "x: above\n")
    write("deep/er/file.yaml", "defaults: [parts/a.yaml]\n")
    assert load("deep/er/file.yaml") == {"x": "above"}
    write("deep/er/parts/a.yaml", "x: beside\n")
    assert load(tmp_path / "deep" / "er" / "file.yaml") == {"x": "beside"}
    write("mine.yaml", "defaults: [conf/agent.yaml]\nmodel: {init_args: {omega: 2.0}}\n")
    found = load("mine.yaml", "invert")
    assert found["model"]["init_args"]["omega"] == 2.0
    assert found["data"]["init_args"]["domain"] == "agent"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("defaults: [missing.yaml]", "a.yaml: key 'defaults': expected configuration files, found no missing.yaml"),
        ("defaults: [a.yaml]", "a.yaml: key 'defaults': a.yaml builds on a.yaml itself"),
        ("defaults: [b.yaml]", "b.yaml: key 'defaults': a.yaml builds on b.yaml itself"),
        ("defaults: b.yaml", "a.yaml: key 'defaults': expected a list of configuration files, found b.yaml"),
        ("defaults: [1]", "a.yaml: key 'defaults': expected a list of configuration files, found [1]"),
        ("- 1", "a.yaml: expected a mapping of keys, found a list"),
        ("'3'", "a.yaml: expected a configuration file (YAML), found no mapping of keys"),
        ("model: {x: 1", "a.yaml: expected a configuration file (YAML), found "),
        ("model: 1\nmodel: 2\n", "a.yaml: expected a configuration file (YAML), found "),
        ("defaults: 3", "a.yaml: key 'defaults': expected a list of configuration files, found 3"),
        ("defaults: {b.yaml: 1}", "a.yaml: key 'defaults': expected a list of configuration files"),
        (f"defaults: [{'b' * 5000}]", "expected configuration files, found bbb"),
        ('defaults: ["\\0"]', "expected configuration files, found no"),
        ("defaults: [below.yaml]\nmodel: [1]", "a.yaml: expected keys that go together"),
    ],
)
def test_mistakes_in_a_file_name_it_in_one_short_line(text: str, expected: str) -> None:
    write("below.yaml", "model: {omega: 1}")
    write("a.yaml", text)
    write("b.yaml", "defaults: [a.yaml]")
    with pytest.raises(UserError) as told:
        load("a.yaml")
    assert expected in str(told.value)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 400


def test_a_command_line_gets_the_content_of_its_files() -> None:
    write("a.yaml", "x: 1.0e-3\n")
    for given in (["--config", "a.yaml"], ["--config=a.yaml"], ["-c", "a.yaml"]):
        (text,) = Arguments.read(given).expanded()
        assert yaml.safe_load(text.removeprefix("--config=")) == {"x": 1e-3}
        assert Arguments.read([text]).expanded() == [text]
    assert Arguments.read(["--config", "{x: 2}", "--config"]).expanded() == ["--config={x: 2}", "--config"]


def test_arguments_are_positional_ones_and_options() -> None:
    given = ["a", "-h", "b", "--x", "-1", "--y=", "--print_config", "c", "--z", "--u+", "v", "w"]
    arguments = Arguments.read(given)
    assert arguments.positional == ("a", "b", "c", "w")
    assert arguments.options == (("help", None), ("x", "-1"), ("y", ""), ("print_config", None), ("z", None), ("u+", "v"))
    assert arguments.words() == ["a", "b", "c", "w", "--help", "--x=-1", "--y=", "--print_config", "--z", "--u+=v"]
    assert Arguments.read(arguments.words()) == arguments
    assert arguments.without("x").values("x") == []
    assert arguments.values("z") == [""]


def test_the_shipped_files_are_those_of_the_repository_and_what_is_there_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find("conf/agent.yaml").read_bytes() == (CONF / "agent.yaml").read_bytes()
    assert (shipped("pretrained/agent") / "config.json").is_file()
    write("conf/agent.yaml", "x: mine\n")
    assert load("conf/agent.yaml") == {"x": "mine"}
    monkeypatch.chdir(ROOT)
    assert find("conf/agent.yaml") == Path("conf/agent.yaml")


@pytest.mark.parametrize("path", ["conf/../cli.py", "cli.py", "domains/agent", "pretrained/nothing", "/conf/agent.yaml", ""])
def test_nothing_else_of_the_package_is_shipped(path: str) -> None:
    assert shipped(path) == Path(path)


def test_sections_count_for_their_verb_alone_and_after_the_other_keys_of_their_file() -> None:
    write("a.yaml", "x: 1\ny: 1\nfit: {x: 2}\ninvert: {x: 3, z: {u: 1}}\n")
    write("b.yaml", "defaults: [a.yaml]\nx: 4\nfit: {y: 5}\ninvert: {z: {v: 2}}\n")
    assert load("a.yaml", "fit") == {"x": 2, "y": 1}
    assert load("b.yaml", "fit") == {"x": 4, "y": 5}  # file after file, in each its section at the end
    assert load("b.yaml", "invert") == {"x": 4, "y": 1, "z": {"u": 1, "v": 2}}
    assert load("b.yaml", "validate") == load("b.yaml", "test") == load("b.yaml", "fit")
    assert [(path.name, keys) for path, keys in parts("a.yaml", "invert")] == [
        ("a.yaml", {"x": 1, "y": 1}),
        ("a.yaml", {"x": 3, "z": {"u": 1}}),
    ]
    assert yaml.safe_load(Arguments.read(["--config=b.yaml"]).expanded("fit")[0].removeprefix("--config=")) == {"x": 4, "y": 5}
    write("a.yaml", "x: 1\nfit: {x: 2}\n")
    assert load("a.yaml", "ablate") == load("a.yaml") == {"x": 1, "fit": {"x": 2}}  # files of other verbs have no sections


def test_an_empty_section_is_none_and_one_that_is_no_mapping_is_refused() -> None:
    write("a.yaml", "x: 1\nfit:\n")
    assert load("a.yaml", "fit") == {"x": 1}
    write("a.yaml", "x: 1\nfit: [1]\n")
    for verb in ("fit", "invert"):
        with pytest.raises(UserError, match=r"a\.yaml: key 'fit': expected a mapping of keys, found \[1\]"):
            load("a.yaml", verb)


def test_settings_go_with_a_domain_by_its_name() -> None:
    assert settings_of("agent") == "conf/agent.yaml"
    assert settings_of("agent", "conf/in_context") == "conf/in_context/agent.yaml"
    assert settings_of("object_rearrangement", "conf/in_context") == settings_of("chess") == "conf/own.yaml"
    write("conf/chess.yaml", "defaults: [conf/verb.yaml, conf/method/ftl_igm.yaml]\n")
    assert settings_of("chess") == "conf/own.yaml"  # for pretraining alone
    write(
        "conf/chess.yaml", "defaults: [conf/verb.yaml, conf/method/ftl_igm.yaml]\ninvert: {model: {init_args: {pretrained: x}}}\n"
    )
    assert settings_of("chess") == "conf/chess.yaml"


read_once = functools.cache(_read)


@functools.cache
def shipped_parts(path: Path, verb: str) -> list[tuple[Path, dict[str, Any]]]:
    """For several tests: reading YAML takes long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftl_lightning.services.configuration._read", lambda path: copy.deepcopy(read_once(path.resolve())))
        return parts(path, verb)


@pytest.mark.slow
def test_there_are_at_most_fifty_configuration_files_and_every_part_is_used_by_one() -> None:
    files = {path.resolve() for path in CONF.rglob("*.yaml")}
    assert 0 < len(files) <= 50
    inside = {path for path in files if path.relative_to(CONF.resolve()).parts[0] in PARTS}
    used = {part.resolve() for path in files - inside for verb in SECTIONS for part, _ in shipped_parts(path, verb)}
    added = {"language.yaml", "regression.yaml"}  # overlays of a configuration
    assert inside - used == {CONF.resolve() / "method" / name for name in added}
    assert inside


def leaves(keys: dict[str, object], at: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    """Values with their keys, an argument of a class as one."""
    for key, value in keys.items():
        if isinstance(value, dict) and "init_args" not in at and (at[:1] != ("trainer",) or key in ("logger", "init_args")):
            yield from leaves(value, (*at, key))
        else:
            yield (*at, key), value


@functools.cache
def defaults_of(path: str) -> dict[str, object]:
    """The arguments of a class with their defaults, those that it passes on to the classes above it included."""
    module, _, name = path.rpartition(".")
    found: dict[str, object] = {}
    for one in getattr(importlib.import_module(module), name).__mro__:
        if "__init__" not in vars(one):
            continue
        own = inspect.signature(one.__init__).parameters.values()
        found = {parameter.name: parameter.default for parameter in own} | found
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in own):
            break
    return found


ENTRIES = [(verb, names) for verb, names in CONFIGS if verb in SECTIONS]
OTHERWISE = {("evaluation", "replan")}
"""Values whose default is another one where :class:`~ftl_lightning.few_shot.tuned.ModelSettings` reads them."""


def repeated(verb: str, names: list[str]) -> dict[tuple[str, str, str], bool]:
    """Of every value of the files of a run, by file and key, whether it says what is so without it.

    Then the files before it give the value already or, where none of them has the key, it is the default of the class. Where a
    file that is added changes a class, references to other keys go with the former one.
    """
    found = [(str(part), keys) for name in names for part, keys in shipped_parts((CONF / f"{name}.yaml").resolve(), verb)]
    classes = {"evaluation": "ftl_lightning.evaluation.evaluator.Evaluator", "trainer": "ftl_lightning.training.trainer.Trainer"}
    for _, keys in found:
        classes |= {key: keys[key]["class_path"] for key in ("model", "data") if "class_path" in keys.get(key, {})}
    assert set(classes) == {"model", "data", "evaluation", "trainer"}
    before: dict[tuple[str, ...], object] = {}
    says = {}
    for part, keys in found:
        own = dict(leaves(keys))
        changed = {key[0] for key in own if key[1:] == ("class_path",) and key in before}
        before = {key: value for key, value in before.items() if key[0] not in changed or "${" not in str(value)}
        for key, value in own.items():
            default = defaults_of(classes[key[0]]).get(key[-1], ...) if key[0] in classes and "logger" not in key else ...
            says[verb, part, ".".join(key)] = before.get(key, default) == value and key not in OTHERWISE
        before |= own
    return says


def test_a_configuration_says_only_what_differs() -> None:
    """Every value of a file makes a difference in a run that the file is part of."""
    useless: dict[tuple[str, str, str], bool] = {}
    for verb, names in ENTRIES:
        for place, same in repeated(verb, names).items():
            useless[place] = useless.get(place, True) and same
    assert len(useless) > 300
    assert [place for place, same in useless.items() if same] == []


def test_sections_do_not_say_the_same() -> None:
    """What counts for both stands above them."""
    for path in CONF.rglob("*.yaml"):
        keys = yaml.safe_load(path.read_text())
        fit, invert = (dict(leaves(keys.get(name, {}))) for name in SECTIONS)
        assert [key for key in fit.keys() & invert.keys() if fit[key] == invert[key]] == [], path
