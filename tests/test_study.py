"""The study with people: its page, its key, what raters' files may be, and the table of what they say."""

import json
import math
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.apps.study.questions import read_films
from ftl_lightning.apps.study.report import (
    Key,
    Question,
    Report,
    inattention,
    krippendorff_alpha,
    read_key,
    read_rater,
    study_table,
)
from ftl_lightning.cli.main import main
from ftl_lightning.services.errors import UserError
from tests.conftest import refused
from tests.study import FILMED, FRAMES, METHODS, NEW, PEOPLE, TRAINING, make, simulated, write_films

QUESTIONS = 18 + 1 + 2 + 2 + 6
"""Films, a standing one, two instructions, two repeats, comparisons."""


@pytest.fixture
def films(tmp_path: Path) -> Path:
    return write_films(tmp_path / "films")


@pytest.fixture
def key(films: Path, tmp_path: Path) -> Key:
    return read_key(make(films, tmp_path / "study").key)


def page_data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


# The page.


def test_a_page_holds_its_films_and_asks_the_papers_two_questions_and_nothing_of_a_network(films: Path, tmp_path: Path) -> None:
    made = make(films, tmp_path / "study")
    data, text = page_data(made.page), made.page.read_text(encoding="utf-8")
    assert (made.films, made.questions) == (len(METHODS) * 6 + 1, QUESTIONS)
    assert len(data["films"]) == made.films
    texts = [question["text"] for question in data["questions"]]
    for concept in (*TRAINING, *NEW):
        assert texts.count(f"Does this film depict “{concept}”?") >= 3
        assert texts.count(f"Which film depicts “{concept}” best?") == 1
    assert made.size == made.page.stat().st_size < 100_000
    assert {len(film["points"]) for film in data["films"].values()} == {FRAMES * 14 * 3 * 2 * 4 // 3}  # lengths tell nothing

    assert not re.search("https?:", text)
    assert "default-src 'none'" in text


def test_a_page_does_not_say_which_method_is_which(films: Path, tmp_path: Path) -> None:
    made = make(films, tmp_path / "study")
    data = page_data(made.page)
    told = json.dumps({name: value for name, value in data.items() if name != "films"})
    assert not any(re.search(rf"\b{method}\b", told) for method in METHODS)
    assert not re.search(r"check\"|expected|safetensors|scenario|method", told)
    key = read_key(made.key)
    assert {film.method for film in key.films.values()} == set(METHODS)
    numbers = {method: [int(name[1:]) for name, film in key.films.items() if film.method == method] for method in METHODS}
    assert all(max(own) - min(own) > 6 for own in numbers.values())  # dealt out


def test_the_same_films_and_seed_give_the_same_bytes_and_others_another_study_whose_key_is_not_lost(
    films: Path, tmp_path: Path
) -> None:
    one, same, other = (make(films, tmp_path / name, seed=seed) for name, seed in (("a", 0), ("b", 0), ("c", 1)))
    assert one.page.read_bytes() == same.page.read_bytes()
    assert one.key.read_bytes() == same.key.read_bytes()
    assert one.study != other.study
    make(films, tmp_path / "a")
    with pytest.raises(UserError, match=r"key.json: expected no key of another study, found that of \w{16}; name another folder"):
        make(films, tmp_path / "a", seed=1)


def test_a_domain_without_points_is_shown_in_animations(films: Path, tmp_path: Path) -> None:
    drawn, animated = make(films, tmp_path / "a"), make(films, tmp_path / "b", domain=FILMED)
    data = page_data(animated.page)
    assert data["drawing"] is None
    assert all(film["gif"].startswith("R0lGOD") and film["seconds"] > 0 for film in data["films"].values())
    assert animated.size > 3 * drawn.size


def test_words_cannot_leave_their_place_in_the_page(films: Path, tmp_path: Path) -> None:
    made = make(films, tmp_path / "study", title="</title><b>&", consent="</script><script>alert(1)</script>\n\n{minutes} minutes")
    text = made.page.read_text(encoding="utf-8")
    assert "<b>" not in text
    assert text.count("<script") == 2
    assert page_data(made.page)["consent"].endswith("4 minutes")


def test_all_methods_are_shown_from_the_same_rows_which_are_drawn(films: Path) -> None:
    found = read_films(films, PEOPLE, 2, 0)
    assert len(found) == 2 * 18
    walks = {(film.scenario, film.setting) for film in found if film.concept == "walk"}
    assert walks == {("walk 0", "training"), ("walk 1", "training")}
    assert {film.setting for film in found if film.concept == "chop wood"} == {"new"}
    single = [{film.row for film in read_films(films, PEOPLE, 1, seed) if film.concept == "walk"} for seed in range(6)]
    assert all(len(rows) == 1 for rows in single)
    assert set.union(*single) == {0, 1}


def test_a_listing_says_scenarios_rows_and_checks(films: Path) -> None:
    walk = {"concept": "walk", "row": 1, "scenario": "walk, raised", "setting": "composed"}
    listing = [{**walk, "method": name, "file": f"{name}/walk.safetensors"} for name in METHODS]
    check = {"concept": "standing on one's hands", "method": "check-no", "file": "Ours/run.safetensors"}
    (films / "films.json").write_text(json.dumps([*listing, check]))
    found = read_films(films, PEOPLE, 1, 0)
    assert [(film.scenario, film.setting, film.row) for film in found[:3]] == [("walk, raised", "composed", 1)] * 3
    assert found[3].concept == "standing on one's hands"


def listed(content: str) -> Any:
    return lambda folder: (folder / "films.json").write_text(content)


def one_film(file: str, **more: int) -> Any:
    return listed(json.dumps([{"concept": "walk", "method": "BC", "file": file, **more}]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (shutil.rmtree, "films: expected a folder of generated behaviour, found no"),
        (lambda made: [shutil.rmtree(made / name) for name in METHODS], "expected films.json or files METHOD/CONCEPT.safetensors"),
        (lambda made: (made / "VAE/run.safetensors").unlink(), "scenario 'run': expected a film of each of BC, Ours, VAE, found"),
        (lambda made: (made / "VAE/run.safetensors").write_text("no"), "run.safetensors: expected a demonstrations file"),
        (listed("{"), "films.json: expected JSON"),
        (listed("[]"), "films.json: films: expected a list with one or more films, found []"),
        (listed('[{"concept": "walk"}]'), "films.json: key 'films[0].method': expected a value, found none"),
        (listed('[{"film": 1}]'), "films.json: key 'films[0].film': expected one of concept, method, file"),
        (one_film("BC/walk.safetensors", row=9), "key 'row' of BC/walk.safetensors: expected 0 to 1, found 9"),
        (one_film("no.safetensors"), "no.safetensors: expected a demonstrations file, found nothing"),
    ],
)
def test_films_that_are_missing_or_damaged_are_told_in_one_line(films: Path, change: Any, message: str) -> None:
    change(films)
    with pytest.raises(UserError, match=re.escape(message), check=lambda error: "\n" not in str(error)):
        make(films, Path("study"))
    assert not Path("study").exists()


def test_mistakes_in_a_study_are_told(films: Path, capsys: pytest.CaptureFixture[str]) -> None:
    people, unseen = (["study", f"tests.study:{name}", "--films", str(films)] for name in ("PEOPLE", "UNSEEN"))
    few = "expected 3 samples or more in every method's file, found 2; see --scenarios"
    refused(capsys, [*people, "--scenarios", "3"], few)
    refused(capsys, unseen, "domain: expected a domain whose plans are filmed, found unseen")
    refused(capsys, [*people, "--repeats=-1"], "repeats: expected 0 or more, found -1")
    (films / "films.json").write_text("{")
    refused(capsys, [*people, "--out=study"], "films.json: expected JSON")


# Agreement.


def test_agreement_is_that_of_published_examples_one_where_all_agree_and_unknown_where_nothing_varies() -> None:
    # Krippendorff, "Computing Krippendorff's Alpha-Reliability", 2011: part A (two categories), C and D (values missing)
    meg, owen = "0100000010", "1110010000"
    assert krippendorff_alpha(list(zip(meg, owen, strict=True))) == pytest.approx(0.095, abs=5e-4)
    four = ("123321412...", "1233224125.3", ".3332342251.", "12332441251.")
    units = [[value for value in unit if value != "."] for unit in zip(*four, strict=True)]
    assert krippendorff_alpha(units) == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha([("yes", "yes"), ("no", "no")]) == 1
    assert math.isnan(krippendorff_alpha([("yes", "yes"), ("yes", "yes")]))
    assert krippendorff_alpha([("yes", "no"), ("no", "yes")]) < 0
    assert krippendorff_alpha([("yes",), ("yes", "yes"), ("no", "no")]) == 1


# The report.


def chosen(counts: Mapping[str, int], kind: str) -> Any:
    """Somebody who says, of training concepts, a method's name so many times: as best, or of its films that they depict theirs."""

    def opinion(question: Question, key: Key) -> str | None:
        shown = [key.films[name] for name in question.films]
        if question.kind == "best" and kind == "best" and question.setting == "training":
            turn = TRAINING.index(question.scenario)
            method = [name for name, count in counts.items() for _ in range(count)][turn]
            return next(name for name in question.films if key.films[name].method == method)
        if question.kind in ("depicts", "repeat") and kind == "depicts" and shown[0].setting == "training":
            return "yes" if TRAINING.index(shown[0].concept) < counts[shown[0].method] else "no"
        return None

    return opinion


def table_of(key: Key, folder: Path, opinions: Any) -> Report:
    files = [simulated(folder / f"answers-{number}.json", key, f"r{number}", opinion) for number, opinion in enumerate(opinions)]
    return study_table(files, folder / "study" / "key.json")


def rounded(shares: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    return {name: (round(share.mean, 1), round(share.spread, 1)) for name, share in shares.items()}


def test_means_and_deviations_are_those_of_the_papers_table(key: Key, tmp_path: Path) -> None:
    # The paper: five raters, three scenarios, judged best 20 ± 16.3, 0 ± 0, 80 ± 16.3; that is what 0, 1, 1, 1, 0 of 3 give.
    opinions = [chosen({"BC": one, "Ours": 3 - one}, "best") for one in (0, 1, 1, 1, 0)]
    found = table_of(key, tmp_path, opinions).shares
    said = {method: found["training", "best", method] for method in METHODS}
    assert rounded(said) == {"BC": (20.0, 16.3), "VAE": (0.0, 0.0), "Ours": (80.0, 16.3)}
    assert said["Ours"].answers == 15
    # Wilson's interval of 12 of 15: (2 k + z^2 ± z sqrt(z^2 + 4 k (1 - k / n))) / (2 (n + z^2))
    assert (said["Ours"].low, said["Ours"].high) == pytest.approx((54.81, 92.95), abs=0.01)
    assert said["VAE"].low == 0


def test_depicting_is_counted_in_films_of_the_method_alone(key: Key, tmp_path: Path) -> None:
    # 46.7 ± 16.3 of the paper's second line: 1, 1, 1, 2, 2 of 3.
    opinions = [chosen({"BC": 2, "VAE": one, "Ours": 3}, "depicts") for one in (1, 1, 1, 2, 2)]
    report = table_of(key, tmp_path, opinions)
    found = {method: report.shares["training", "depicts", method] for method in METHODS}
    assert rounded(found) == {"BC": (66.7, 0.0), "VAE": (46.7, 16.3), "Ours": (100.0, 0.0)}
    assert report.shares["new", "depicts", "Ours"].mean == 100
    assert report.agreement["new", "depicts"] == 1
    assert 0.5 < report.agreement["training", "depicts"] < 1
    assert math.isnan(report.agreement["new", "best"])  # all always chose ours
    assert report.scenarios == {"training": 3, "new": 3}


def test_the_report_is_printed_with_what_was_left_out(key: Key, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "study"
    for number in range(3):
        simulated(folder / f"answers-{number}.json", key, f"r{number}")
    simulated(folder / "answers-3.json", key, "r3", lambda question, key: "yes" if question.kind != "best" else None)
    (folder / "answers-4.json").write_text("{")
    assert main(["study-report", *sorted(map(str, folder.glob("answers*.json")))]) == 0
    out, err = capsys.readouterr()
    assert "3 raters; scenarios: 3 training, 3 new" in out
    assert re.search(r"training \| judged best +\| +0.0 ± 0.0 \(0 to 30\) \| +100.0 ± 0.0 \(70 to 100\) \|", out)
    assert "Wilson" in out
    assert "answers-3.json: 2 of 3 attention checks answered wrongly; left out" in err
    assert "refused: " in err
    assert "answers-4.json: expected a study answers file" in err
    assert main(["study-report", str(folder), "--all_raters", "true"]) == 0
    out, err = capsys.readouterr()
    assert "4 raters" in out
    assert "; kept" in err


def test_raters_fail_by_a_wrong_check_or_by_answering_repeats_in_two_ways(key: Key, tmp_path: Path) -> None:
    def failing(opinion: Any) -> str:
        return inattention(read_rater(simulated(tmp_path / "one.json", key, "r", opinion), key), key)

    def contrary(count: int) -> Any:
        films = [repeat.films for repeat in key.of_kind("repeat").values()][:count]

        def opinion(question: Question, key: Key) -> str | None:
            if question.kind == "repeat" and question.films in films:
                return "no" if key.films[question.films[0]].method == "Ours" else "yes"
            return None

        return opinion

    assert failing(lambda question, key: None) == ""
    assert failing(contrary(1)) == ""
    assert failing(contrary(2)) == "2 of 2 questions that were asked twice answered in two ways"
    wrong = failing(lambda question, key: "no" if question.expected == "yes" else None)
    assert wrong == "1 of 3 attention checks answered wrongly"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"study": "0" * 16}, "key 'study': expected .* found '0{16}'; the answers are of another study"),
        ({"page": "0" * 16}, "the answers are of another page"),
        ({"finished": None}, f"expected {QUESTIONS} answers of a finished run, found {QUESTIONS}"),
        ({"answers": []}, f"expected {QUESTIONS} answers of a finished run, found 0"),
        ({"answers": [None]}, f"expected {QUESTIONS} answers of a finished run, found 0"),
        ({"answers": [{"id": "q99", "answer": "yes"}]}, "expected one answer to each question, found"),
        ({"answers": [7]}, "expected one answer to each question, found 7"),
        ({"answers": [{"id": ["q01"]}]}, "expected one answer to each question"),
        ({"answers": {}}, "expected a rater and a list of answers, found a damaged file"),
        ({"rater": None}, "expected a rater and a list of answers, found a damaged file"),
        ({"kind": "study key"}, "expected a study answers file, found a study key file"),
        ({"format": 2}, "key 'format': expected 1, found 2"),
        ({"opinion": lambda question, key: "perhaps"}, r"answers.json: answer to q01: expected .* found 'perhaps'"),
    ],
)
def test_answers_of_another_study_or_of_an_unfinished_run_or_that_the_page_cannot_give_are_refused(
    key: Key, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = simulated(tmp_path / "answers.json", key, "r", **changes)
    with pytest.raises(UserError, match=message, check=lambda error: str(path) in str(error) and "\n" not in str(error)):
        read_rater(path, key)


def test_a_rater_counts_once(key: Key, tmp_path: Path) -> None:
    first, second = (simulated(tmp_path / f"answers-{name}.json", key, "same") for name in "ab")
    report = study_table([first, second, first], tmp_path / "study" / "key.json")
    assert report.raters == 1
    (told,) = report.refused
    assert "expected another rater than" in told


def test_a_report_of_nothing_or_with_a_damaged_key_is_told(key: Key, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = ["--key", str(tmp_path / "study" / "key.json")]
    answers = simulated(tmp_path / "answers.json", key, "r")
    for arguments, message in (
        ([], "answers: expected files that raters saved, found none"),
        (["no.json", *known], "no.json: expected a study answers file, found nothing; there is nothing left"),
        ([str(tmp_path / "films"), *known], "expected files answers*.json in this folder, found none"),
        ([str(answers)], "key.json: expected a study key file, found nothing"),
    ):
        refused(capsys, ["study-report", *arguments], message)
    for content in ("", "[]", "{}", "\x00", '{"kind": "study key", "format": 1, "study": "x"}'):
        (tmp_path / "key.json").write_text(content)
        refused(capsys, ["study-report", str(answers)], "key.json: ", "expected")
