"""Configuration files: parts, their order, their mistakes, and what is shipped."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from ftl_lightning.configuration import expanded, find, load, parts
from ftl_lightning.errors import UserError
from ftl_lightning.shipped import FOLDERS, shipped
from tests.conftest import CONF, ROOT

GROUPS = ("verb", "domain", "sampling", "method")


def write(path: str, text: str) -> str:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)
    return path


def test_later_parts_win_and_a_file_wins_over_its_parts() -> None:
    write("a.yaml", "model: {x: 1, y: 1, z: 1}\nlist: [1, 2, 3]\n")
    write("b.yaml", "model: {y: 2, z: 2}\n")
    write("c.yaml", "defaults: [a.yaml, b.yaml]\nmodel: {z: 3}\nlist: [4]\nseed: ${other}\n")
    assert load("c.yaml") == {"model": {"x": 1, "y": 2, "z": 3}, "list": [4], "seed": "${other}"}
    assert [path.name for path in parts("c.yaml")] == ["a.yaml", "b.yaml", "c.yaml"]


def test_a_part_is_looked_for_beside_the_file_then_above_it_then_among_the_shipped_ones(tmp_path: Path) -> None:
    write("parts/a.yaml", "x: above\n")
    write("deep/er/file.yaml", "defaults: [parts/a.yaml]\n")
    assert load("deep/er/file.yaml") == {"x": "above"}
    write("deep/er/parts/a.yaml", "x: beside\n")
    assert load(tmp_path / "deep" / "er" / "file.yaml") == {"x": "beside"}
    write("mine.yaml", "defaults: [conf/invert/agent.yaml]\nmodel: {init_args: {omega: 2.0}}\n")
    found = load("mine.yaml")
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
    ],
)
def test_mistakes_in_a_file_name_it(text: str, expected: str) -> None:
    write("a.yaml", text)
    write("b.yaml", "defaults: [a.yaml]")
    with pytest.raises(UserError) as told:
        load("a.yaml")
    assert expected in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("defaults: 3", "a.yaml: key 'defaults': expected a list of configuration files, found 3"),
        ("defaults: {b.yaml: 1}", "a.yaml: key 'defaults': expected a list of configuration files"),
        (f"defaults: [{'b' * 5000}]", "expected configuration files, found bbb"),
        ('defaults: ["\\0"]', "expected configuration files, found no"),
        ("defaults: [below.yaml]\nmodel: [1]", "a.yaml: expected keys that go together"),
    ],
)
def test_odd_defaults_are_told_in_one_short_line(text: str, expected: str) -> None:
    write("below.yaml", "model: {omega: 1}")
    write("a.yaml", text)
    with pytest.raises(UserError) as told:
        load("a.yaml")
    assert expected in str(told.value)
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 400


def test_a_command_line_gets_the_content_of_its_files() -> None:
    write("a.yaml", "x: 1.0e-3\n")
    for given in (["--config", "a.yaml"], ["--config=a.yaml"], ["-c", "a.yaml"]):
        *_, value = expanded(["fit", *given])[-1].split("=")
        assert yaml.safe_load(value) == {"x": 1e-3}
    inline = ["--config", "{x: 2}", "--y=3", "--config"]
    assert expanded(inline) == inline
    assert expanded(expanded(["--config", "a.yaml"])) == expanded(["--config", "a.yaml"])


def test_the_shipped_files_are_those_of_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find("conf/agent.yaml").read_bytes() == (CONF / "agent.yaml").read_bytes()
    assert (shipped("pretrained/agent") / "config.json").is_file()
    monkeypatch.chdir(ROOT)
    assert find("conf/agent.yaml") == Path("conf/agent.yaml")


def test_what_is_there_wins_over_what_is_shipped() -> None:
    write("conf/agent.yaml", "x: mine\n")
    assert load("conf/agent.yaml") == {"x": "mine"}


@pytest.mark.parametrize("path", ["conf/../cli.py", "cli.py", "domains/agent", "pretrained/nothing", "/conf/agent.yaml", ""])
def test_nothing_else_of_the_package_is_shipped(path: str) -> None:
    assert shipped(path) == Path(path)


def test_every_part_is_used_by_a_configuration() -> None:
    files = {path.resolve() for path in CONF.rglob("*.yaml")}
    inside = {path for path in files if path.relative_to(CONF.resolve()).parts[0] in GROUPS}
    used = {part.resolve() for path in files - inside for part in parts(path)}
    assert inside <= used
    assert inside


def test_a_configuration_says_only_what_differs() -> None:
    """No key of a file repeats the value that its parts give it already."""

    def repeated(own: object, below: object, at: str) -> list[str]:
        if isinstance(own, dict) and isinstance(below, dict):
            return [key for name in own.keys() & below.keys() for key in repeated(own[name], below[name], f"{at}.{name}")]
        return [at] if own == below else []

    for path in CONF.rglob("*.yaml"):
        own = yaml.safe_load(path.read_text())
        if names := own.pop("defaults", None):
            below = Path("below.yaml")
            below.write_text(yaml.safe_dump({"defaults": [str(CONF / name) for name in names]}))
            assert repeated(own, load(below), str(path)) == []


def test_a_wheel_holds_every_configuration_and_model(tmp_path: Path) -> None:
    setuptools = pytest.importorskip("setuptools", reason="builds a wheel without the package index")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("needs setuptools 77")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("ftl_lightning", "conf", "pretrained"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    offline = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *offline, "--wheel-dir", tmp_path, source], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        (scripts,) = [archive.read(name).decode() for name in inside if name.endswith("entry_points.txt")]
    for folder in FOLDERS:
        files = [path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file()]
        assert files
        assert {f"ftl_lightning/{path.as_posix()}" for path in files} <= inside
    assert "ftl-lightning = ftl_lightning.cli:main" in scripts
