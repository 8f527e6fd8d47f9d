"""Write the tables of the page on Meta-World from the rows of its ablations: ``results/*.md``.

    python table.py

Success in closed loop of every method on the test tasks of ML10 and ML45, on training tasks, and on ML45's training tasks left out
in turn; each task; paired tests of ours against every method; the settings that were tried.
"""

import argparse
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import pandas as pd
from ftl_metaworld.tasks import NAMES, NUMBER

from ftl_lightning.reporting.paired import holm, sign_flip

RESULTS = Path(__file__).resolve().parent / "results"
SUCCESS = "closed loop success"
METHODS: Mapping[str, tuple[str, str]] = {
    "**FTL-IGM, with adapter**": ("FTL-IGM", "with adapter"),
    "FTL-IGM, the paper's form": ("FTL-IGM", ""),
    "LoRA fine-tuning of our model": ("LoRA fine-tuning", ""),
    "full fine-tuning of our model": ("full fine-tuning", ""),
    "BC, same network, full fine-tuning": ("BC, same network, full fine-tuning", ""),
    "BC, same network, LoRA": ("BC, same network, LoRA fine-tuning", ""),
    "BC, same network, concept alone": ("BC, same network", ""),
    "BC from scratch": ("BC from scratch", ""),
    "in-context": ("in-context", ""),
    "language": ("language", ""),
    "*shifted demonstration, not learned*": ("shifted demonstration", ""),
    "*expert, scripted*": ("expert (oracle)", ""),
}
"""Method and form of the rows, by name in the tables; references in italics."""
OURS = "**FTL-IGM, with adapter**"
TUNED = {
    "tuning": "five, every 8 steps",
    "tuning_few": "three, every 2 steps",
    "tuning_slow": "three, every 8 steps",
    "tuning_fold": "five, every 2 steps, after 40 tasks",
}
"""Rows of settings that were tried, and what they have in common."""
TEMPERATURES = (0.5, 1.0)
"""Temperatures of our model in the order of ``conf/tuning_few.yaml``."""


def number(value: float) -> str:
    """Two digits, without the zero before the point."""
    return f"{value:.2f}".removeprefix("0") if value < 1 else f"{value:.2f}"


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines)) + "\n"


def of(rows: pd.DataFrame, name: str) -> pd.DataFrame:
    """Rows of a method by its name in the tables."""
    method, form = METHODS[name]
    return rows[(rows["method"] == method) & (rows["form"] == form)]


def cell(rows: pd.DataFrame) -> str:
    """Mean ± standard error over tasks, and in brackets the standard deviation of the mean over seeds; a dash without rows."""
    if rows.empty:
        return "-"
    tasks = rows.groupby("task")["value"].mean().to_numpy()
    text = number(tasks.mean()) + (f" ± {number(tasks.std(ddof=1) / len(tasks) ** 0.5)}" if len(tasks) > 1 else "")
    seeds = rows.groupby("seed")["value"].mean().to_numpy()
    return text + (f" ({number(seeds.std())})" if len(seeds) > 1 else "")


def summary(rows: pd.DataFrame) -> str:
    """Every method in every setting."""
    groups = {
        "ML10, test": (["ml10"], "new concept"),
        "ML45, test": (["ml45"], "new concept"),
        "ML45, left out in turn": ([f"ml45-{fold}" for fold in range(1, 10)], "new concept"),
        "ML10, training": (["ml10"], "training concept"),
        "ML45, training": (["ml45"], "training concept"),
    }
    parts = {name: rows[rows["domain"].isin(domains) & (rows["setting"] == setting)] for name, (domains, setting) in groups.items()}
    parts = {name: part for name, part in parts.items() if len(part)}
    head = ["success", *(f"{name} ({part['task'].nunique()} tasks)" for name, part in parts.items())]
    return table(head, [[name, *(cell(of(part, name)) for part in parts.values())] for name in METHODS])


def each(rows: pd.DataFrame, domain: str) -> str:
    """Every method on each test task."""
    part = rows[(rows["domain"] == domain) & (rows["setting"] == "new concept")]
    tasks = list(dict.fromkeys(part["task"]))
    names = [NAMES[NUMBER[task]] for task in tasks]
    lines = [[name, *(cell(found[found["task"] == task]) for task in tasks)] for name in METHODS if len(found := of(part, name))]
    return table([f"success, {domain.upper()}", *names], lines)


def paired(rows: pd.DataFrame, tuned: Collection[str]) -> str:
    """Ours against every method: two-sided sign-flip tests over the test tasks, over the tasks left out in turn, and over those of
    them that are not among the ``tuned`` tasks, on which settings were tried.
    """
    new = rows[rows["setting"] == "new concept"]
    left = new["domain"].str.contains("-")
    groups = {"test tasks": new[~left], "left out in turn": new[left], "and not tuned on": new[left & ~new["task"].isin(tuned)]}
    lines = []
    for group, part in groups.items():
        means = {name: of(part, name).groupby(["task", "seed"])["value"].mean() for name in METHODS}
        others = {name: other for name, other in means.items() if name != OURS}
        apart = {name: (means[OURS] - other).dropna().groupby("task").mean() for name, other in others.items()}  # seeds of both
        apart = {name: differences for name, differences in apart.items() if len(differences)}
        p_values = holm([sign_flip((differences / len(differences)).tolist()) for differences in apart.values()])
        for (name, differences), p in zip(apart.items(), p_values, strict=True):
            better, worse = int((differences > 1e-6).sum()), int((differences < -1e-6).sum())
            counts = f"{better} / {len(differences) - better - worse} / {worse}"
            lines.append([f"{group} ({len(differences)})", name, f"{differences.mean():+.2f}", counts, f"{p:.3f}"])
    return table(["tasks", "ours against", "difference", "tasks ahead / equal / behind", "p (Holm)"], lines)


def tuning(folder: Path) -> str:
    """Settings of every method on the validation tasks."""
    lines = []
    for name, means in TUNED.items():
        tried: dict[tuple[str, str], int] = {}
        rows = read(folder / f"{name}.csv")
        rows = rows.assign(called=[f"{method} {form}".strip() for method, form in zip(rows["method"], rows["form"], strict=True)])
        for (called, variant, omega, _), part in rows.groupby(["called", "variant", "omega", "config_hash"], sort=False):
            setting = f"{variant}, omega {omega}" if omega != "none" else str(variant)
            before = tried[str(called), setting] = tried.get((str(called), setting), -1) + 1
            if name == "tuning_few" and called in ("FTL-IGM with adapter", "LoRA fine-tuning"):
                setting += f", temperature {TEMPERATURES[before]:g}"
            lines.append([means, str(called), setting, number(float(part["value"].mean()))])
    return table(["demonstrations, plans", "method", "setting", "success on the validation tasks"], lines)


def forgotten(rates: Mapping[str, Mapping[str, float]]) -> str:
    """Mean success on the training tasks before and after a test task was learned."""
    lines = [[method, number(each["before"]), number(each["after"]), str(each["pairs"])] for method, each in rates.items()]
    head = ["learned by", "training tasks before", "training tasks after", "pairs of test task and training task"]
    return table(head, lines)


def experts(rates: Mapping[str, Mapping[str, float]]) -> str:
    """Mean success of the experts, and the tasks that they do not solve."""
    lines = []
    for key in ("observed", "hidden"):
        failed = [name for name, each in rates.items() if each[key] < 0.5]
        lines.append([key, number(sum(each[key] for each in rates.values()) / len(rates)), ", ".join(failed) or "none"])
    return table(["goal", "success, mean of 50 tasks", "tasks with success below one half"], lines)


def cost(values: Mapping[str, float]) -> str:
    """Processor time of one core."""
    return table(["what", "processor time"], [[name, f"{value:g}"] for name, value in values.items()])


def composed(rows: pd.DataFrame) -> str:
    """Tasks behind a wall by a composition, by the task without a wall, and by their own training concept."""
    ours = rows[(rows["domain"] == "ml45") & (rows["method"] == "FTL-IGM") & (rows["form"] == "with adapter")]
    named = {"composition": "both concepts", "one of both": "without the way past a wall", "training concept": "its own concept"}
    goals = list(dict.fromkeys(ours[ours["setting"] == "composition"]["task"]))
    lines = [
        [NAMES[NUMBER[goal]], *(cell(ours[(ours["task"] == goal) & (ours["setting"] == setting)]) for setting in named)]
        for goal in goals
    ]
    return table(["success", *named.values()], lines)


def read(path: Path) -> pd.DataFrame:
    """Rows of success; none without a file."""
    if not path.is_file():
        return pd.DataFrame(
            columns=["domain", "setting", "task", "method", "form", "variant", "omega", "seed", "config_hash", "value"]
        )
    rows = pd.read_csv(path, dtype={"omega": str}, keep_default_na=False, na_values={"value": [""]})
    return rows[rows["metric"] == SUCCESS]


def main() -> None:
    """Write all tables whose rows exist."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the rows and tables")
    folder: Path = parser.parse_args().results
    rows = pd.concat([read(folder / "table.csv"), read(folder / "folds.csv")])
    published = pd.read_csv(Path(__file__).parent / "published.csv", dtype=str, keep_default_na=False)
    tuned = {task for name in TUNED for task in read(folder / f"{name}.csv")["task"]}
    made = {"summary": summary(rows), "paired": paired(rows, tuned)}
    made["published"] = table(list(map(str, published)), published.to_numpy().tolist())
    made |= {f"{domain}": each(rows, domain) for domain in ("ml10", "ml45") if domain in set(rows["domain"])}
    if "composition" in set(rows["setting"]):
        made["composition"] = composed(rows)
    for name, write in (("forgetting", forgotten), ("experts", experts), ("cost", cost)):
        if (path := folder / f"{name}.json").is_file():
            made[f"{name}"] = write(json.loads(path.read_text("utf-8")))
    made["tuning"] = tuning(folder)
    for name, text in made.items():
        (folder / f"{name}.md").write_text(text, "utf-8")
    for name, text in made.items():
        print(f"{name}.md\n\n{text}")


if __name__ == "__main__":
    main()
