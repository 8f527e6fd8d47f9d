"""The study with people: its page, its key, what raters' files may be, and the table of what they say."""

import json
import re
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from ftl_lightning.cli import main
from ftl_lightning.errors import UserError
from ftl_lightning.study.agreement import krippendorff_alpha
from ftl_lightning.study.answers import Key, inattention, read_key, read_rater
from ftl_lightning.study.films import read_films
from ftl_lightning.study.page import Made, make_study
from ftl_lightning.study.questions import ask
from ftl_lightning.study.report import Report, study_table
from tests.study import FILMED, FRAMES, METHODS, NEW, PEOPLE, TRAINING, simulated, write_films

QUESTIONS = 18 + 1 + 2 + 2 + 6
"""Films, a standing one, two instructions, two repeats, comparisons."""


@pytest.fixture
def films(tmp_path: Path) -> Path:
    return write_films(tmp_path / "films")


def make(films: Path, out: Path, **options: Any) -> Made:
    told = {"domain": PEOPLE, "scenarios": 1, "repeats": 2, "still": 1, "seed": 0} | options
    domain, scenarios, repeats, still, seed = (told.pop(name) for name in ("domain", "scenarios", "repeats", "still", "seed"))
    questions = ask(read_films(films, domain, scenarios, seed), repeats, still, seed)
    return make_study(domain, questions, out, **told)


@pytest.fixture
def key(films: Path, tmp_path: Path) -> Key:
    return read_key(make(films, tmp_path / "study").key)


def page_data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


# The page.


def test_a_page_holds_its_films_and_asks_the_papers_two_questions(films: Path, tmp_path: Path) -> None:
    made = make(films, tmp_path / "study")
    data = page_data(made.page)
    assert (made.films, made.questions) == (len(METHODS) * 6 + 1, QUESTIONS)
    assert len(data["films"]) == made.films
    texts = [question["text"] for question in data["questions"]]
    for concept in (*TRAINING, *NEW):
        assert texts.count(f"Does this film depict “{concept}”?") >= 3
        assert texts.count(f"Which film depicts “{concept}” best?") == 1
    assert made.size == made.page.stat().st_size < 100_000
    assert {len(film["points"]) for film in data["films"].values()} == {FRAMES * 14 * 3 * 2 * 4 // 3}  # lengths tell nothing


def test_a_page_asks_nothing_of_a_network_and_does_not_say_which_method_is_which(films: Path, tmp_path: Path) -> None:
    made = make(films, tmp_path / "study")
    text = made.page.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert "default-src 'none'" in text
    data = page_data(made.page)
    told = json.dumps({name: value for name, value in data.items() if name != "films"})
    assert not any(re.search(rf"\b{method}\b", told) for method in METHODS)
    assert not re.search(r"check\"|expected|safetensors|scenario|method", told)
    key = read_key(made.key)
    assert {film["method"] for film in key.films.values()} == set(METHODS)
    numbers = {method: [int(name[1:]) for name, film in key.films.items() if film["method"] == method] for method in METHODS}
    assert all(max(own) - min(own) > 6 for own in numbers.values())  # dealt out


def test_the_same_films_and_seed_give_the_same_bytes_and_others_do_not(films: Path, tmp_path: Path) -> None:
    one, same, other = (make(films, tmp_path / name, seed=seed) for name, seed in (("a", 0), ("b", 0), ("c", 1)))
    assert one.page.read_bytes() == same.page.read_bytes()
    assert one.key.read_bytes() == same.key.read_bytes()
    assert one.study != other.study


def test_the_key_of_another_study_is_not_lost(films: Path, tmp_path: Path) -> None:
    make(films, tmp_path / "study")
    make(films, tmp_path / "study")
    with pytest.raises(UserError, match=r"key.json: expected no key of another study, found that of \w{16}; name another folder"):
        make(films, tmp_path / "study", seed=1)


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
    assert {film.scenario for film in found if film.concept == "walk"} == {"walk 0", "walk 1"}
    assert {film.setting for film in found if film.concept == "walk"} == {"training"}
    assert {film.setting for film in found if film.concept == "chop wood"} == {"new"}
    single = [{film.row for film in read_films(films, PEOPLE, 1, seed) if film.concept == "walk"} for seed in range(6)]
    assert all(len(rows) == 1 for rows in single)
    assert set.union(*single) == {0, 1}


def test_a_listing_says_scenarios_rows_and_checks(films: Path) -> None:
    listing = [{"concept": "walk", "method": name, "file": f"{name}/walk.safetensors", "row": 1} for name in METHODS]
    listing = [{**entry, "scenario": "walk, raised", "setting": "composed"} for entry in listing]
    check = {"concept": "standing on one's hands", "method": "check-no", "file": "Ours/run.safetensors"}
    (films / "films.json").write_text(json.dumps([*listing, check]))
    found = read_films(films, PEOPLE, 1, 0)
    assert [(film.scenario, film.setting, film.row) for film in found[:3]] == [("walk, raised", "composed", 1)] * 3
    assert found[3].concept == "standing on one's hands"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: shutil.rmtree(folder), "films: expected a folder of generated behaviour, found no"),
        (
            lambda folder: [shutil.rmtree(folder / name) for name in METHODS],
            "expected films.json or files METHOD/CONCEPT.safetensors",
        ),
        (
            lambda folder: (folder / "VAE" / "run.safetensors").unlink(),
            "scenario 'run': expected a film of each of BC, Ours, VAE, found",
        ),
        (lambda folder: (folder / "VAE" / "run.safetensors").write_text("no"), "run.safetensors: expected a demonstrations file"),
        (lambda folder: (folder / "films.json").write_text("{"), "films.json: expected JSON"),
        (lambda folder: (folder / "films.json").write_text("[]"), "films.json: expected a list of films, found an empty one"),
        (lambda folder: (folder / "films.json").write_text('[{"concept": "walk"}]'), "film 0: key 'method': expected a text"),
        (lambda folder: (folder / "films.json").write_text('[{"film": 1}]'), "film 0: expected the keys concept, method, file"),
        (
            lambda folder: (folder / "films.json").write_text(
                '[{"concept": "walk", "method": "BC", "file": "BC/walk.safetensors", "row": 9}]'
            ),
            "key 'row' of BC/walk.safetensors: expected 0 to 1, found 9",
        ),
        (
            lambda folder: (folder / "films.json").write_text('[{"concept": "walk", "method": "BC", "file": "no.safetensors"}]'),
            "no.safetensors: expected a demonstrations file, found nothing",
        ),
    ],
)
def test_films_that_are_missing_or_damaged_are_told_in_one_line(
    films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, message: str
) -> None:
    change(films)
    assert main(["study", "tests.study:PEOPLE", "--films", str(films), "--out", str(tmp_path / "study")]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not (tmp_path / "study").exists()


def test_too_few_samples_and_a_domain_without_films_are_told(films: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "tests.study:PEOPLE", "--films", str(films), "--scenarios", "3"]) == 2
    assert "expected 3 samples or more in every method's file, found 2; see --scenarios" in capsys.readouterr().err
    assert main(["study", "tests.study:UNSEEN", "--films", str(films)]) == 2
    assert "domain: expected one whose plans are filmed, found unseen" in capsys.readouterr().err
    assert main(["study", "tests.study:PEOPLE", "--films", str(films), "--repeats=-1"]) == 2
    assert "repeats: expected 0 or more, found -1" in capsys.readouterr().err


# Agreement.


def test_agreement_is_that_of_published_examples() -> None:
    # Krippendorff, "Computing Krippendorff's Alpha-Reliability", 2011: part A (two categories), C and D (values missing)
    meg, owen = "0100000010", "1110010000"
    assert krippendorff_alpha(list(zip(meg, owen, strict=True))) == pytest.approx(0.095, abs=5e-4)
    four = ("123321412...", "1233224125.3", ".3332342251.", "12332441251.")
    units = [[value for value in unit if value != "."] for unit in zip(*four, strict=True)]
    assert krippendorff_alpha(units) == pytest.approx(0.743, abs=5e-4)


def test_agreement_is_one_where_all_agree_and_unknown_where_nothing_varies() -> None:
    assert krippendorff_alpha([("yes", "yes"), ("no", "no")]) == 1
    assert krippendorff_alpha([("yes", "yes"), ("yes", "yes")]) != krippendorff_alpha([("yes", "yes"), ("yes", "yes")])  # NaN
    assert krippendorff_alpha([("yes", "no"), ("no", "yes")]) < 0
    assert krippendorff_alpha([("yes",), ("yes", "yes"), ("no", "no")]) == 1


# The report.


def chosen(counts: Mapping[str, int], kind: str) -> Any:
    """Somebody who says, of training concepts, a method's name so many times: as best, or of its films that they depict theirs."""

    def opinion(question: Mapping[str, Any], key: Key) -> str | None:
        shown = [key.films[name] for name in question["films"]]
        if question["kind"] == "best" and kind == "best" and question["setting"] == "training":
            turn = TRAINING.index(question["scenario"])
            method = [name for name, count in counts.items() for _ in range(count)][turn]
            return next(name for name in question["films"] if key.films[name]["method"] == method)
        if question["kind"] in ("depicts", "repeat") and kind == "depicts" and shown[0]["setting"] == "training":
            return "yes" if TRAINING.index(shown[0]["concept"]) < counts[shown[0]["method"]] else "no"
        return None

    return opinion


def table_of(key: Key, folder: Path, opinions: Any) -> Report:
    files = [simulated(folder / f"answers-{number}.json", key, f"r{number}", opinion) for number, opinion in enumerate(opinions)]
    return study_table(files, folder / "study" / "key.json")


def test_means_and_deviations_are_those_of_the_papers_table(key: Key, tmp_path: Path) -> None:
    # The paper: five raters, three scenarios, judged best 20 ± 16.3, 0 ± 0, 80 ± 16.3; that is what 0, 1, 1, 1, 0 of 3 give.
    opinions = [chosen({"BC": one, "Ours": 3 - one}, "best") for one in (0, 1, 1, 1, 0)]
    found = table_of(key, tmp_path, opinions).shares
    said = {method: found["training", "best", method] for method in METHODS}
    assert {name: (round(share.mean, 1), round(share.spread, 1)) for name, share in said.items()} == {
        "BC": (20.0, 16.3),
        "VAE": (0.0, 0.0),
        "Ours": (80.0, 16.3),
    }
    assert said["Ours"].answers == 15
    # Wilson's interval of 12 of 15: (2 k + z^2 ± z sqrt(z^2 + 4 k (1 - k / n))) / (2 (n + z^2))
    assert (said["Ours"].low, said["Ours"].high) == pytest.approx((54.81, 92.95), abs=0.01)
    assert said["VAE"].low == 0


def test_depicting_is_counted_in_films_of_the_method_alone(key: Key, tmp_path: Path) -> None:
    # 46.7 ± 16.3 of the paper's second line: 1, 1, 1, 2, 2 of 3.
    opinions = [chosen({"BC": 2, "VAE": one, "Ours": 3}, "depicts") for one in (1, 1, 1, 2, 2)]
    report = table_of(key, tmp_path, opinions)
    found = {method: report.shares["training", "depicts", method] for method in METHODS}
    assert [(round(found[name].mean, 1), round(found[name].spread, 1)) for name in METHODS] == [
        (66.7, 0.0),
        (46.7, 16.3),
        (100.0, 0.0),
    ]
    assert report.shares["new", "depicts", "Ours"].mean == 100
    assert report.agreement["new", "depicts"] == 1
    assert 0.5 < report.agreement["training", "depicts"] < 1
    assert report.agreement["new", "best"] != report.agreement["new", "best"]  # all always chose ours: NaN
    assert report.scenarios == {"training": 3, "new": 3}


def test_the_report_is_printed_with_what_was_left_out(key: Key, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "study"
    for number in range(3):
        simulated(folder / f"answers-{number}.json", key, f"r{number}")
    simulated(folder / "answers-3.json", key, "r3", lambda question, key: "yes" if question["kind"] != "best" else None)
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

    repeats = list(key.of_kind("repeat").values())

    def contrary(count: int) -> Any:
        films = [repeat["films"] for repeat in repeats[:count]]
        other = {"Ours": "no"}

        def opinion(question: Mapping[str, Any], key: Key) -> str | None:
            if question["kind"] == "repeat" and question["films"] in films:
                return other.get(key.films[question["films"][0]]["method"], "yes")
            return None

        return opinion

    assert failing(lambda question, key: None) == ""
    assert failing(contrary(1)) == ""
    assert failing(contrary(2)) == "2 of 2 questions that were asked twice answered in two ways"
    wrong = failing(lambda question, key: "no" if question.get("expected") == "yes" else None)
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
    ],
)
def test_answers_of_another_study_or_of_an_unfinished_run_are_refused(
    key: Key, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = simulated(tmp_path / "answers.json", key, "r", **changes)
    with pytest.raises(UserError, match=message) as told:
        read_rater(path, key)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)


def test_an_answer_that_the_page_cannot_give_is_refused(key: Key, tmp_path: Path) -> None:
    path = simulated(tmp_path / "answers.json", key, "r", lambda question, key: "perhaps")
    with pytest.raises(UserError, match=r"answers.json: answer to q01: expected .* found 'perhaps'"):
        read_rater(path, key)


def test_a_rater_counts_once(key: Key, tmp_path: Path) -> None:
    first, second = (simulated(tmp_path / f"answers-{name}.json", key, "same") for name in "ab")
    report = study_table([first, second, first], tmp_path / "study" / "key.json")
    assert report.raters == 1
    assert len(report.refused) == 1
    assert "expected another rater than" in report.refused[0]


@pytest.mark.parametrize("content", ["", "[]", "{}", "\x00", '{"kind": "study key", "format": 1, "study": "x"}'])
def test_a_damaged_key_is_told(key: Key, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str) -> None:
    answers = simulated(tmp_path / "answers.json", key, "r")
    (tmp_path / "key.json").write_text(content)
    assert main(["study-report", str(answers)]) == 2
    told = capsys.readouterr().err
    assert "key.json: expected" in told
    assert told.count("\n") == 1


def test_a_report_of_nothing_says_what_was_wrong(key: Key, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = str(tmp_path / "study" / "key.json")
    assert main(["study-report"]) == 2
    assert "answers: expected files that raters saved, found none" in capsys.readouterr().err
    assert main(["study-report", "no.json", "--key", known]) == 2
    assert "no.json: expected a study answers file, found nothing; there is nothing left" in capsys.readouterr().err
    assert main(["study-report", str(tmp_path / "films"), "--key", known]) == 2
    assert "expected files answers*.json in this folder, found none" in capsys.readouterr().err
    answers = simulated(tmp_path / "answers.json", key, "r")
    assert main(["study-report", str(answers)]) == 2
    assert "key.json: expected a study key file, found nothing" in capsys.readouterr().err


# The page in a browser.


class Browser:
    """A headless browser with a folder for downloads and a memory that outlives it."""

    def __init__(self, folder: Path) -> None:
        webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
        browser, driver = (shutil.which("chromium") or shutil.which("google-chrome")), shutil.which("chromedriver")
        if browser is None or driver is None:
            pytest.skip("no chromium with chromedriver is installed, so that the page is not tested in a browser")
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = browser
        for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--window-size=420,800"):
            options.add_argument(argument)
        options.add_argument(f"--user-data-dir={folder / 'profile'}")
        self.downloads = folder / "downloads"
        options.add_experimental_option("prefs", {"download.default_directory": str(self.downloads)})
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(driver))

    def one(self, selector: str) -> Any:
        from selenium.webdriver.common.by import By

        return self.driver.find_element(By.CSS_SELECTOR, selector)

    @property
    def question(self) -> str:
        text: str = self.one("h1").text
        return text

    @property
    def answered(self) -> int:
        return int(self.one("#bar").get_attribute("aria-valuenow"))

    def press(self, key: str) -> None:
        """One key, as soon as the film has been shown."""
        before, deadline = self.answered, time.monotonic() + 20
        while self.driver.execute_script("return document.querySelector('button[data-key]').disabled"):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        self.one("body").send_keys(key)
        assert self.answered == before + 1

    def answer(self) -> None:
        """As somebody attentive who says no to everything and takes the first film."""
        self.press("1" if self.question.startswith("Which") else "y" if "answer Yes" in self.question else "n")


@pytest.fixture
def study(films: Path, tmp_path: Path) -> Made:
    return make(films, tmp_path / "study")


def test_somebody_rates_everything_with_a_break_and_the_report_takes_the_file(
    study: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    browser = Browser(tmp_path)
    try:
        browser.driver.get(study.page.as_uri())
        assert not browser.one("#start").is_enabled()
        browser.one("#agree").click()
        browser.one("#age").send_keys("31")
        browser.one("#start").click()
        for _ in range(7):
            browser.answer()
        drawn = "const c = document.querySelector('canvas'); return c.getContext('2d').getImageData(0, 0, c.width, c.height).data"
        assert len(set(browser.driver.execute_script(drawn))) > 20  # shades
        assert browser.driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
        asked = browser.question
        browser.driver.refresh()
        assert (browser.question, browser.answered) == (asked, 7)
        for _ in range(5):
            browser.answer()
        asked = browser.question
        assert browser.driver.get_log("browser") == []
    finally:
        browser.driver.quit()
    browser = Browser(tmp_path)  # another day
    try:
        browser.driver.get(study.page.as_uri())
        assert (browser.question, browser.answered) == (asked, 12)
        browser.one("body").send_keys("\ue003")  # Backspace
        assert browser.one("button.chosen").is_displayed()  # of the question before, which may read the same
        browser.one("button.chosen").click()
        assert browser.question == asked
        assert browser.driver.execute_script("return document.querySelector('button.chosen')") is None
        for _ in range(study.questions - 12):
            browser.answer()
        assert browser.question.startswith("Thank you")
        browser.one("#save").click()
        deadline = time.monotonic() + 20
        while not (saved := list(browser.downloads.glob("answers-*.json"))):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert browser.driver.get_log("browser") == []
    finally:
        browser.driver.quit()
    content = json.loads(saved[0].read_text())
    assert content["age"] == 31
    assert [entry["place"] for entry in content["answers"]] == list(range(study.questions))
    assert all(entry["milliseconds"] >= 0 for entry in content["answers"])
    assert main(["study-report", str(saved[0]), "--key", str(study.key)]) == 0
    out, err = capsys.readouterr()
    assert "1 rater; scenarios: 3 training, 3 new" in out
    assert err == ""


def test_raters_see_films_in_other_orders_and_repeats_apart(study: Made, tmp_path: Path) -> None:
    key = read_key(study.key)
    repeated = [tuple(question["films"]) for question in key.of_kind("repeat").values()]
    browser = Browser(tmp_path)
    shown = "return JSON.parse(localStorage.getItem('study-' + JSON.parse(document.getElementById('data').textContent).study))"
    try:
        orders = []
        for _ in range(2):
            browser.driver.get(study.page.as_uri())
            browser.driver.execute_script("localStorage.clear()")
            browser.driver.refresh()
            browser.one("#agree").click()
            browser.one("#start").click()
            browser.driver.execute_script("setInterval(() => document.querySelector('button[data-key]:enabled')?.click(), 10)")
            deadline = time.monotonic() + 60
            while browser.answered < study.questions:
                assert time.monotonic() < deadline
                time.sleep(0.1)
            answers = browser.driver.execute_script(shown)["answers"].values()
            orders.append([entry["id"] for entry in sorted(answers, key=lambda entry: entry["place"])])
    finally:
        browser.driver.quit()
    assert sorted(orders[0]) == sorted(orders[1]) == sorted(key.questions)
    assert orders[0] != orders[1]
    for order in orders:
        kinds = [key.questions[name]["kind"] == "best" for name in order]
        assert kinds == sorted(kinds)  # films alone come first
        asked = [tuple(key.questions[name]["films"]) for name in order]
        for films in repeated:
            first, second = [place for place, found in enumerate(asked) if found == films][:2]
            assert second - first > 1
