"""Scripts for Slurm: what they say, what they refuse to say, and that they run a grid."""

import os
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from ftl_lightning.apps.ablation.plan import Stage
from ftl_lightning.apps.ablation.record import read_record
from ftl_lightning.apps.ablation.slurm import Wave, script, waves, write_scripts
from ftl_lightning.evaluation.results import read_rows
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.trust import vouching
from tests.apps.ablation.raylets import QUICK, write_plan
from tests.conftest import environment, succeed

STAGES = [
    Stage("fit", "a.yaml", options={"model.output": "models/{seed}"}, resources={"cpus": 4, "gpus": 1, "memory_gb": 7.5}),
    Stage("invert", "c.yaml"),
    Stage("invert", "b.yaml", options={"model.pretrained": "models/{seed}"}),
    Stage("invert", "b.yaml", options={"model.pretrained": "models/{seed}/pretrained"}, name="other"),
]
PLAN = {number: [cell for seed in (0, 1) for cell in stage.cells(seed)] for number, stage in enumerate(STAGES, 1)}


def test_stages_wait_for_the_models_that_they_read_and_a_script_asks_for_what_its_largest_cell_books() -> None:
    first, second = waves(PLAN)
    assert [(wave.numbers, len(wave.cells)) for wave in (first, second)] == [((1, 2), 4), ((3, 4), 4)]
    options = {"partition": "long", "exclusive": "", "time": "1-02:00:00"}
    lines = script(first, Path("/p/grid.sh.yaml"), Path("/p"), 3, options).splitlines()
    assert [line for line in lines if line.startswith("#SBATCH")] == [
        "#SBATCH --job-name=grid",
        "#SBATCH --array=1-3",
        "#SBATCH --ntasks=1",
        "#SBATCH --cpus-per-task=4",
        "#SBATCH --gres=gpu:1",
        "#SBATCH --mem=7500M",
        "#SBATCH --partition=long",
        "#SBATCH --exclusive",
        "#SBATCH --time=1-02:00:00",
    ]
    assert lines[-1].endswith("--only '[1, 2]' --shard \"$SLURM_ARRAY_TASK_ID/3\"")
    plain = script(second, Path("/p/grid.sh.yaml"), Path("/p"))
    assert "--array=1-4\n" in plain
    assert "gres" not in plain
    assert "mem" not in plain


def write_srun(content: str) -> None:
    Path("srun").write_text(f"#!/bin/bash\n{content}")
    Path("srun").chmod(0o755)


def test_what_a_user_gives_is_quoted(tmp_path: Path) -> None:
    (wave, _) = waves(PLAN)
    folder = tmp_path / 'it\'s $(touch bad) "here"; touch bad'
    folder.mkdir()
    with vouching(["my.module"]):
        text = script(wave, folder / "plan `touch bad`.yaml", folder)
    Path("s.sh").write_text(text)
    write_srun('pwd > "$OUT"\nprintf "%s\\n" "$@" >> "$OUT"\n')
    variables = environment(PATH=f"{tmp_path}:{os.environ['PATH']}", SLURM_ARRAY_TASK_ID="2", OUT=str(tmp_path / "out"))
    subprocess.run(["bash", "s.sh"], env=variables, check=True)
    place, *words = Path("out").read_text().splitlines()
    assert place == str(folder)
    assert words[words.index("--config") + 1] == str(folder / "plan `touch bad`.yaml")
    assert words[words.index("--trust") + 1] == "my.module"
    assert words[-2:] == ["--shard", "2/4"]
    assert not list(tmp_path.rglob("bad"))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"partition": "a\ntouch bad"}, "sbatch.partition: expected a value of letters, digits"),
        ({"partition": "a b"}, "sbatch.partition"),
        ({"time": "$(date)"}, "sbatch.time"),
        ({"cpus-per-task": "2%"}, "sbatch.cpus-per-task"),
        ({"array": "1-9"}, "sbatch: expected options of sbatch without array, ntasks, wrap"),
        ({"--mem": "1"}, "sbatch: expected options"),
    ],
)
def test_options_that_could_be_misread_are_refused(options: dict[str, str], told: str) -> None:
    with pytest.raises(UserError, match=told):
        script(waves(PLAN)[0], Path("p.yaml"), Path("/p"), 1, options)


def test_resources_that_slurm_does_not_know_are_refused() -> None:
    (cell,) = Stage("invert", "a.yaml", resources={"near": 1}).cells(0)
    with pytest.raises(UserError, match=r"resources.near: expected cpus, gpus or memory_gb, which Slurm knows"):
        script(Wave((1,), (cell,)), Path("p.yaml"), Path("/p"))


SRUN = """
while [ "${1#--}" != "$1" ]; do shift; done
export SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_JOB_ID=$SLURM_ARRAY_JOB_ID SLURM_JOB_NAME=grid
export SLURM_NODELIST=localhost
exec "$@"
"""
"""What srun does with a single task on this machine: Lightning finds itself in a job of Slurm."""


@pytest.mark.slow
def test_the_jobs_of_an_array_run_a_grid_between_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = write_plan(tmp_path / "a.yaml", QUICK | {"grid": {"model.omega": [1.0, 1.2]}})
    arguments = ["ablate", "--config", str(plan), "--slurm", "my grid.sh", "--sbatch", '{partition: long, time: "02:00:00"}']
    succeed(*arguments)
    assert capsys.readouterr().out == "sbatch 'my grid.sh'\n"
    subprocess.run(["bash", "-n", "my grid.sh"], check=True)
    assert "submit this file by sbatch" in subprocess.run(["bash", "my grid.sh"], capture_output=True, text=True).stderr
    assert yaml.safe_load(Path("my grid.sh.yaml").read_text())["results"] == "r.csv"
    plan.unlink()  # jobs that wait run what was submitted
    write_srun(SRUN)
    variables = environment(PATH=f"{tmp_path}:{os.environ['PATH']}", SLURM_ARRAY_JOB_ID="7", SLURM_ARRAY_TASK_ID="2")
    variables.pop("OMP_NUM_THREADS")
    assert [line for line in Path("my grid.sh").read_text().splitlines() if "--array" in line] == ["#SBATCH --array=1-2"]
    # One job as Slurm runs it, and the other's command in this process, which has imported everything.
    subprocess.run(["bash", "my grid.sh"], env=variables, check=True)
    words = shlex.split(Path("my grid.sh").read_text().splitlines()[-1])
    succeed(*(word.replace("$SLURM_ARRAY_TASK_ID", "1") for word in words[words.index("ftl_lightning") + 1 :]))
    assert {entry.state for entry in read_record("r.csv").values()} == {"done"}
    rows = read_rows("r.csv").query("role == 'method'")
    one, other = (rows[rows["omega"] == omega] for omega in ("1.0", "1.2"))
    assert len(one) == len(other) == len(rows) / 2 > 0
    capsys.readouterr()
    succeed("ablate", "--config", "my grid.sh.yaml")  # what two jobs wrote is one whole
    assert capsys.readouterr().out.count("in the results already") == 2


def test_several_scripts_are_submitted_one_after_another() -> None:
    first, second = write_scripts("grid.sh", STAGES, PLAN, {"results": "r.csv", "seeds": [0, 1], "root": ""}, 3)
    assert first == "job1=$(sbatch --parsable grid.1.sh)"
    assert second == "job2=$(sbatch --parsable --dependency=afterok:${job1%%;*} grid.2.sh)"
    assert shlex.split(Path("grid.2.sh").read_text().splitlines()[-1])[-1] == "$SLURM_ARRAY_TASK_ID/3"
    for name in ("grid.1.sh", "grid.2.sh"):
        subprocess.run(["bash", "-n", name], check=True)
    frozen = yaml.safe_load(Path("grid.sh.yaml").read_text())
    assert [Stage(**stage) for stage in frozen["stages"]] == [replace(stage, seeds=[]) for stage in STAGES]
