"""A stranger's method goes through the benchmark: a valid submission, its check, what a check finds, and hostile files."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ftl_lightning.apps.benchmark.check import allowed, check_submission, drawn, shifted
from ftl_lightning.apps.benchmark.leaderboard import References, leaderboard, read_submissions
from ftl_lightning.apps.benchmark.run import Candidate
from ftl_lightning.apps.benchmark.submission import Row, Run, Submission, scored
from ftl_lightning.apps.benchmark.suite import load_suite
from ftl_lightning.cli.main import main
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.services.errors import LONGEST
from ftl_lightning.services.shipped import MODELS
from ftl_lightning.services.tensor_file import file_hash
from tests.conftest import ROOT, Once, succeed

RUN = ["benchmark", "replay", "--suites", "beats"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder in which the example is installed, as pip would."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "examples" / "ftl-replay" / "ftl_replay", folder / "ftl_replay")
    card = folder / "ftl_replay-0.1.0.dist-info"
    card.mkdir()
    (card / "METADATA").write_text("Metadata-Version: 2.1\nName: ftl-replay\nVersion: 0.1.0\n")
    (card / "entry_points.txt").write_text("[ftl_lightning.methods]\nreplay = ftl_replay:METHOD\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield folder


@pytest.fixture(scope="module")
def submitted(site: Path, once: Once) -> Path:
    """The submission of the stranger's method on one suite."""
    torch.set_num_threads(1)
    return once("submitted", lambda folder: succeed(*RUN, "--out", "replay.json")) / "replay.json"


@pytest.fixture
def copy(submitted: Path) -> Path:
    """Its file alone, in the test's folder."""
    return Path(shutil.copy(submitted, "replay.json"))


def line_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that refuses a command."""
    capsys.readouterr()
    assert main(["benchmark", *arguments]) == 2
    told = capsys.readouterr().err
    (found,) = [line for line in told.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in told
    assert len(found) <= LONGEST
    return found


@pytest.mark.slow
def test_a_strangers_method_gives_a_submission_that_passes(submitted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    submission, suites = check_submission(submitted)
    assert (submission.name, list(suites), len(submission.runs)) == ("replay", ["beats"], 3)
    assert {run.origin for run in submission.runs} == {"pretrained"}
    assert submission.scores["beats"].mean > 0.9
    assert all(run.references["demonstrations replayed"][0].measures["accuracy"] == 1 for run in submission.runs)
    assert main(["benchmark", "--check", str(submitted)]) == 0
    assert "replay, 1 suite, 3 runs, 12 rows: whole" in capsys.readouterr().out
    assert main(["benchmark", "replay", "--check", str(submitted)]) == 0
    told = capsys.readouterr().out
    assert "running 1 of 3 runs again, 4 of 12 rows" in told
    assert ": the same" in told


def test_what_was_done_is_not_run_again(submitted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = Submission.load(submitted)
    stopped = scored(replace(whole, runs=whole.runs[:2]))
    stopped.save(Path("replay.json"))
    shutil.copytree(submitted.with_name("replay.work") / "models", "replay.work/models")
    assert not stopped.scores
    assert main([*RUN, "--out", "replay.json"]) == 0
    assert "[1/1] beats, seed 2" in capsys.readouterr().out
    again = Submission.load(Path("replay.json"))
    timeless = [[replace(run, seconds=0, pretraining_seconds=0) for run in one.runs] for one in (whole, again)]
    assert timeless[0] == timeless[1]
    assert again.scores == whole.scores
    assert main([*RUN, "--out", "replay.json"]) == 0
    assert "[1/" not in capsys.readouterr().out


def test_a_file_of_something_else_is_not_gone_on_with(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "expected a submission of the same method" in line_of(capsys, "cvae", "--suites", "beats", "--out", str(copy))
    other = replace(Submission.load(copy), code="0123456789abcdef")  # the method has changed since
    other.save(copy)
    assert "expected a submission of the same code" in line_of(capsys, *RUN[1:], "--out", str(copy))
    copy.unlink()
    Path("replay.work").mkdir()
    assert "found some; remove the folder" in line_of(capsys, *RUN[1:], "--out", str(copy))


def _row(content: Any, run: int = 0, row: int = 0) -> Any:
    return content["runs"][run]["rows"][row]


def _set(path: str, value: Any) -> Callable[[Any], None]:
    """Puts a value where a path of keys leads, such as ``runs.0.seed``."""

    def change(content: Any) -> None:
        *keys, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in keys:
            content = content[key]
        content[last] = value

    return change


TAMPERED: list[tuple[Callable[[Any], None], str]] = [
    (_set("kind", "model"), "kind: expected 'few-shot concepts', found 'model'"),
    (_set("format", 2), "format: expected 1, found 2"),
    (_set("name", "<b>best</b>"), "name: expected letters, digits"),
    (_set("code", "../../etc"), "code: expected a hash of 16 digits"),
    (_set("version", "9" * 1000), "version: expected at most 60 characters, found 1000"),
    (_set("machine", {str(number): "" for number in range(100)}), "machine: expected at most 20 entries, found 100"),
    (_set("seeds", [0, 1]), "seeds: expected [0, 1, 2], found [0, 1]"),
    (_set("suites", {"../../agent": "0"}), "suites: expected some of agent, beats"),
    (_set("suites", {"beats": "0123456789abcdef"}), "suites.beats: expected the frozen suite's hash"),
    (_set("suites", {}), "suites: expected some of agent"),
    (lambda content: content["runs"].pop(), "runs: expected one of beats, seed 2, found none"),
    (lambda content: content["runs"].append(content["runs"][0]), "runs[3]: expected one run of beats, seed 0, found two"),
    (_set("runs.0.seed", 7), "runs[0].seed: expected one of [0, 1, 2], found 7"),
    (_set("runs.0.suite", "agent"), "runs[0].suite: expected one of beats, found agent"),
    (_set("runs.0.model", "../../etc"), "beats, seed 0: model: expected a hash of 16 digits"),
    (_set("runs.0.data.demonstrations", "0123456789abcdef"), "data.demonstrations: expected the frozen data's hash"),
    (_set("runs.0.data", {}), "beats, seed 0: data.training: expected the frozen data's hash"),
    (_set("runs.0.seconds", -1.0), "beats, seed 0: seconds: expected 0 or more, found -1.0"),
    (_set("runs.0.origin", "elsewhere"), "beats, seed 0: origin: expected pretrained or given"),
    (lambda content: content["runs"][1]["rows"].pop(), "beats, seed 1: rows: expected one of 'beat 103' (new concept), found none"),
    (lambda content: content["runs"][1]["rows"].append(_row(content)), "beats, seed 1: rows: expected one of 'beat 100'"),
    (lambda content: _row(content).update(concept="beat 7"), "beats, seed 0: rows: expected one of 'beat 100'"),
    (lambda content: _row(content).update(n=1000), "beats, seed 0, beat 100: n: expected 50, found 1000"),
    (lambda content: _row(content)["measures"].update(accuracy=1.5), "beat 100: accuracy: expected 0 to 1, found 1.5"),
    (
        lambda content: _row(content)["measures"].update(accuracy=0.975),
        "accuracy: expected a whole number of 50 samples, found 0.975",
    ),
    (lambda content: _row(content)["measures"].pop("coverage"), "beat 100: measures: expected accuracy, coverage, found accuracy"),
    (lambda content: _row(content)["measures"].update(coverage=-0.5), "coverage: expected 0 or more, found -0.5"),
    (lambda content: _row(content)["measures"].update(accuracy=0.5), "scores.beats.mean: expected"),
    (lambda content: content["scores"]["beats"].update(error=0.0), "scores.beats.error: expected"),
    (_set("scores", {}), "scores: expected beats, found"),
]


@pytest.mark.parametrize(("change", "expected"), TAMPERED, ids=[expected[:40] for _, expected in TAMPERED])
def test_a_tampered_copy_is_refused(
    change: Callable[[Any], object], expected: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(copy.read_text())
    change(content)
    copy.write_text(json.dumps(content))
    assert expected in line_of(capsys, "--check", str(copy))


@pytest.mark.slow
def test_numbers_that_agree_with_one_another_but_were_never_measured_are_found(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(copy.read_text())
    for run in range(3):
        _row(content, run, 1)["measures"]["accuracy"] = 0.5
    copy.write_text(json.dumps(content))
    scored(Submission.load(copy)).save(copy)
    assert main(["benchmark", "--check", str(copy)]) == 0
    assert "expected the submitted numbers, found 1 that differ" in line_of(
        capsys, "replay", "--check", str(copy), "--recompute", "0.1"
    )


def test_another_method_is_not_run_for_a_submission(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = line_of(capsys, "bc", "--check", str(copy))
    assert "method: expected 'replay', the method of the submission, found 'bc'" in told


HOSTILE = [
    (b"", "expected a submission, found damaged text"),
    (b"[" * 100_000, "expected a submission, found damaged text or too deep a nesting"),
    (b'{"kind": NaN}', "expected finite numbers, found nan"),
    (b'{"kind": "a", "kind": "b"}', "key 'kind': expected it once"),
    (b"[]", "content: expected a mapping"),
    (b'{"method": "x"}', "key 'name': expected a value, found none"),
    (b'{"machine": {"processor": {"a": 1}}}', "key 'method': expected a value, found none"),
    (b"\xff\xfe\x00", "found damaged text"),
    (b'{"__class__": "os.system", "method": "x"}', "expected one of kind, format, method"),
]


@pytest.mark.parametrize(("content", "expected"), HOSTILE, ids=[str(index) for index in range(len(HOSTILE))])
def test_a_hostile_file_is_one_line(content: bytes, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.json").write_bytes(content)
    assert expected in line_of(capsys, "--check", "bad.json")


def test_numbers_that_are_none_or_of_another_type_are_one_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = copy.read_text()
    copy.write_text(text.replace('"accuracy": 1.0', '"accuracy": Infinity', 1))
    assert "expected finite numbers" in line_of(capsys, "--check", str(copy))
    copy.write_text(text.replace('"accuracy": 1.0', '"accuracy": "1.0"', 1))
    assert "measures.accuracy'" in line_of(capsys, "--check", str(copy))
    copy.write_text(text.replace('"seed": 0', '"seed": true', 1))
    assert "expected a whole number" in line_of(capsys, "--check", str(copy))


def test_huge_files_devices_and_folders_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with Path("huge.json").open("wb") as file:
        file.truncate(2**31)
    Path("large.json").write_bytes(b" " * 2**23 + b"{}")
    assert "expected a submission file of at most 4194304 bytes" in line_of(capsys, "--check", "large.json")
    assert "at most" in line_of(capsys, "--check", "huge.json")
    os.mkfifo("pipe.json")
    assert "a device, pipe or socket" in line_of(capsys, "--check", "pipe.json")
    Path("folder").mkdir()
    assert "found a folder" in line_of(capsys, "--check", "folder")
    assert "found nothing" in line_of(capsys, "--check", "absent.json")


def test_what_is_run_again_depends_on_the_file_and_the_word_of_whoever_checks(submitted: Path) -> None:
    submission = Submission.load(submitted)
    many = replace(submission, runs=[replace(run, seed=seed) for seed in range(30) for run in submission.runs[:1]])
    chosen = {salt: tuple(run.seed for run in drawn(many, 0.1, salt)) for salt in ("", "a", "b")}
    assert all(len(found) == 3 for found in chosen.values())
    assert len(set(chosen.values())) == 3
    assert drawn(many, 0.1, "a") == drawn(many, 0.1, "a")
    assert drawn(many, 0.0, "a") == []
    assert len(drawn(many, 1.0, "a")) == 30
    assert {run.seed for run in drawn(replace(many, name="other"), 0.1, "a")} != set(chosen["a"])


def test_a_rate_is_the_same_here_and_about_the_same_on_another_machine() -> None:
    assert allowed(0.5, 0.5, 50, rate=True, alike=True)
    assert not allowed(0.5, 0.52, 50, rate=True, alike=True)
    assert allowed(0.5, 0.7, 50, rate=True, alike=False)
    assert not allowed(0.5, 0.9, 50, rate=True, alike=False)
    assert allowed(1.0, 0.96, 50, rate=True, alike=False)
    assert not allowed(1.0, 0.7, 50, rate=True, alike=False)
    assert not allowed(1.0, 1.5, 50, rate=False, alike=False)


def test_the_leaderboard_of_a_folder(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("all").mkdir()
    copy.rename("all/replay.json")
    assert main(["benchmark", "--leaderboard", "page.md", "--submissions", "all"]) == 0
    text = Path("page.md").read_text()
    assert text == leaderboard(read_submissions(Path("all")))
    lines = [line for line in text.splitlines() if line.startswith("| *")]
    assert [line.split("|")[1].strip() for line in lines[-1:]] == ["*random kind (chance)*"]
    assert any(re.match(r"\| \*\*replay\*\*( ≈)? \| 0.99 ± 0.01 \|", line) for line in lines)  # marked on another machine
    shutil.copy("all/replay.json", "all/twice.json")
    assert "expected one submission of 'replay', found two" in line_of(capsys, "--leaderboard", "page.md", "--submissions", "all")
    assert "expected a folder of submissions" in line_of(capsys, "--leaderboard", "page.md", "--submissions", "none")


def page_of(*files: Path) -> str:
    """The leaderboard of some files."""
    folder = Path("all")
    folder.mkdir()
    for path in files:
        shutil.copy(path, folder)
    succeed("benchmark", "--leaderboard", "page.md", "--submissions", "all")
    return Path("page.md").read_text(encoding="utf-8")


def test_no_submission_changes_a_reference_line(copy: Path) -> None:
    submission, honest = Submission.load(copy), committed_references("beats")
    for value, name in ((0.0, "a first"), (1.0, "z last")):
        lines = {
            line: [replace(row, measures=dict.fromkeys(row.measures, value)) for row in rows]
            for line, rows in submission.runs[0].references.items()
        }
        lines["generous (oracle)"] = lines["generator (oracle)"]
        replace(submission, name=name, runs=[replace(run, references=lines) for run in submission.runs]).save(Path(f"{name}.json"))
    page = page_of(copy, Path("a first.json"), Path("z last.json"))
    assert [line for line in page.splitlines() if line.startswith("| *") and line[3] != "*"] == honest
    assert "generous" not in page


def committed_references(name: str) -> list[str]:
    """References of a suite on the committed page, highest first."""
    suite = load_suite(name)
    section = (
        (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8").partition(f"## {suite.title}\n")[2].partition("\n## ")[0]
    )
    return [line for line in section.splitlines() if line.startswith("| *") and line[3] != "*"]


def test_reference_lines_are_those_of_the_committed_results() -> None:
    known = References.load()
    assert known == References.of(Submission.load(ROOT / "results" / "submissions" / "ftl_igm.json"))
    assert known.suites == {name: load_suite(name).hash for name in known.suites}
    for path in (ROOT / "results" / "submissions").glob("*.json"):
        measured = References.of(Submission.load(path)).scores
        assert measured == {name: known.scores[name] for name in measured}


def test_mixed_origins_are_all_shown(copy: Path) -> None:
    submission = Submission.load(copy)
    given = replace(submission.runs[0], origin="given", pretraining_seconds=0.0, model=shipped_hash())
    given = replace(given, data={part: value for part, value in given.data.items() if part != "training"})
    late = [replace(run, pretraining_seconds=8.0) for run in submission.runs[1:]]
    machine = References.load().machine
    replace(submission, machine=machine, runs=[given, *late]).save(copy)
    (line,) = [line for line in page_of(copy).splitlines() if line.startswith("| **replay**")]
    assert [cell.strip() for cell in line.split("|")[4:6]] == ["pretrained (seeds 1, 2), given (seed 0)", "8"]
    assert "≈" not in line


def shipped_hash() -> str:
    return file_hash(MODELS / "agent" / "model.safetensors")


def test_what_cannot_be_recomputed_to_the_digit_is_marked(copy: Path) -> None:
    submission, references = Submission.load(copy), References.load()
    given = [replace(run, origin="given", data={"demonstrations": run.data["demonstrations"]}) for run in submission.runs]
    variants = {
        "exact": {"machine": references.machine},
        "elsewhere": {"machine": {**references.machine, "processor": "Other <b>"}},
        "nameless": {"machine": {}},
        "later": {"machine": references.machine, "version": "9.9"},
        "stranger": {"machine": references.machine, "runs": given},
    }
    for name, changes in variants.items():
        replace(submission, name=name, **changes).save(Path(f"{name}.json"))
    page = page_of(*(Path(f"{name}.json") for name in variants))
    methods = [line.split("|")[1].strip() for line in page.splitlines() if line.startswith("| **")]
    assert sorted(methods) == ["**elsewhere** ≈", "**exact**", "**later** ≈", "**nameless** ≈", "**stranger** ≈"]
    legend = page.partition("≈ These numbers cannot be recomputed")[2]
    assert "- elsewhere: measured with processor Other" in legend
    assert "<b>" not in legend
    assert "- later: measured with ftl" in legend
    assert "- stranger: given models that do not ship: beats" in legend


def elsewhere(path: Path, monkeypatch: pytest.MonkeyPatch, here: float, there: float, coverage: float = 1.0) -> Submission:
    """A submission of another machine, with a rate in all rows and coverage times a factor, and another rate if it is run here."""
    known = Submission.load(path)

    def runs(rate: float, factor: float) -> list[Run]:
        def changed(row: Row) -> Row:
            return replace(row, measures={"accuracy": rate, "coverage": round(row.measures["coverage"] * factor, 6)})

        return [replace(run, rows=[changed(row) for row in run.rows]) for run in known.runs]

    honest = {run.seed: run for run in runs(here, 1.0)}
    monkeypatch.setattr(Candidate, "run", lambda self, suite, seed: honest[seed])
    submission = scored(replace(known, machine={**known.machine, "processor": "another"}, runs=runs(there, coverage)))
    submission.save(path)
    return submission


@pytest.mark.parametrize(("here", "there"), [(0.86, 0.94), (0.92, 1.0), (0.5, 0.64), (0.64, 0.5)])
def test_rates_that_are_all_shifted_are_refused(
    here: float, there: float, copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere(copy, monkeypatch, here, there)
    assert allowed(there, here, 50, rate=True, alike=False)  # each by itself
    assert "expected the submitted numbers, found 1 that differ" in line_of(capsys, "replay", "--check", str(copy))
    assert main(["benchmark", "replay", "--check", str(copy)]) == 2
    told = capsys.readouterr()
    assert "running 3 of 3 runs again, 12 of 12 rows" in told.out
    assert f"differs: beats, mean accuracy of 12 rows: submitted {there:.3f}, found {here:.3f}: " in told.out
    assert "standard errors, expected 3.5 at most" in told.out


def test_distances_that_are_all_less_are_refused(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere(copy, monkeypatch, 0.9, 0.9, coverage=0.85)
    assert main(["benchmark", "replay", "--check", str(copy)]) == 2
    assert "differs: beats, mean coverage of 12 rows: submitted " in capsys.readouterr().out


@pytest.mark.parametrize(("here", "there", "coverage"), [(1.0, 1.0, 1.0), (0.5, 0.54, 0.97), (0.94, 0.9, 1.04), (0.0, 0.0, 1.0)])
def test_small_shifts_elsewhere_pass(
    here: float, there: float, coverage: float, copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere(copy, monkeypatch, here, there, coverage)
    assert main(["benchmark", "replay", "--check", str(copy)]) == 0
    assert "another machine or version: each rate may differ by three standard errors" in capsys.readouterr().err


TWO = {name: load_suite(name) for name in ("beats", "strokes")}


def honest_shifts(seed: int, better: float = 0.0) -> list[str]:
    """Shifts of two suites whose true rates are those of a repetition, or a little better."""
    rng = np.random.default_rng(seed)

    def run(name: str, number: int, more: float) -> Run:
        rows = []
        for index, task in enumerate(TWO[name].test):
            rate = rng.binomial(50, min(0.3 + 0.1 * index + more, 1.0)) / 50
            distance = float(np.exp(rng.normal(0, 0.04)))
            rows.append(Row(setting=task.setting, concept=task.concept, n=50, measures={"accuracy": rate, "coverage": distance}))
        return Run(
            suite=name, seed=number, model="", origin="", data={}, configuration="", pretraining_seconds=0, seconds=0, rows=rows
        )

    return list(shifted([(run(name, number, better), run(name, number, 0.0)) for name in TWO for number in range(3)], TWO))


def test_honest_rates_are_refused_as_seldom_as_the_page_says() -> None:
    assert sum(bool(honest_shifts(seed)) for seed in range(500)) <= 3
    assert sum(bool(honest_shifts(seed, 0.15)) for seed in range(50)) >= 45
    assert any("scores of 2 suites together" in line for seed in range(50) for line in honest_shifts(seed, 0.1))


def test_the_committed_leaderboard_is_what_the_submissions_say() -> None:
    submissions = read_submissions(ROOT / "results" / "submissions")
    page = (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8")
    assert page == leaderboard(submissions), "run: python -m ftl_lightning benchmark --leaderboard docs/leaderboard.md"
    assert "replay" in {one.name for one in submissions}


@pytest.mark.parametrize("form", ["npz", pytest.param("lerobot", marks=pytest.mark.slow)])
def test_data_are_written_with_cards_and_hashes(form: str) -> None:
    pytest.importorskip("pyarrow")
    assert main(["benchmark", "--data", "data", "--suites", "reaches", "--seeds", "0", "--format", form]) == 0
    known = json.loads(Path("data/reaches/hashes.json").read_text())
    assert set(known) == {"training-seed0", "validation-seed0", "demonstrations-seed0"}
    path = "data/reaches/demonstrations-seed0" + (".npz" if form == "npz" else "")
    found = Demonstrations.load(path)
    assert found.hash == known["demonstrations-seed0"]["content"]
    assert (len(found), set(found.concepts)) == (20, {f"reach {number}" for number in range(100, 104)})
    card = Path("data/reaches/README.md").read_text()
    assert "5 of each of 4 new concepts" in card
    assert "reach 103" in card


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["replay", "--suites", "nothing"], "suites: expected some of agent, beats"),
        (["replay", "--suites", "beats,beats"], "expected each suite once"),
        (["replay", "--suites", "beats", "--skip", "beats"], "expected one or more, found none"),
        (["replay", "--suites", "mocap"], "suite mocap: needs your own copy of the recordings (--root FOLDER)"),
        (["replay", "--suites", "beats", "--seeds", "0,x"], "seeds: expected different numbers"),
        (["replay", "--suites", "beats", "--seeds", "1,1"], "seeds: expected different numbers"),
        (["language", "--suites", "beats"], "model: expected models of kind diffusion, which language does not pretrain"),
        (["bc", "--suites", "pictures,beats"], "suite beats: method BC: domain: expected a domain with observed features"),
        (
            ["in_context", "--suites", "pictures"],
            "suite pictures: method in-context: domain: expected a domain with observed features",
        ),
        (["nobody", "--suites", "beats"], "method: expected one of ftl_igm"),
        (["replay", "--suites", "beats", "--model", "absent/{suite}"], "expected a pretrained model for suite beats, found none"),
        (["replay", "--suites", "beats", "--configurations", "absent"], "expected beats.yaml or suites.yaml in absent"),
        (["--data", "data", "--suites", "beats", "--format", "csv"], "format: expected one of npz"),
        (["--data", "data", "--leaderboard", "page.md"], "expected one of --list, --check, --leaderboard and --data"),
        (["--check", "x.json", "--recompute", "2"], "recompute: expected a share from 0 to 1"),
    ],
)
@pytest.mark.usefixtures("site")
def test_mistakes_are_one_line(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "--check" in arguments:
        Path("x.json").write_text("{}")
    assert expected in line_of(capsys, *arguments)


def test_suites_that_a_method_cannot_do_are_left_out_and_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "bc", "--skip", "agent,driving,object_rearrangement,pictures,tabletop"]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: left out: suite ")]
    assert [line.split()[4] for line in told] == ["beats:", "mocap:", "reaches:", "strokes:"]
    assert all("method BC: domain: expected a domain with observed features" in line for line in told if "mocap" not in line)
