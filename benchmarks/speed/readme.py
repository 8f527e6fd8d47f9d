"""Seconds and longest silence of each command and Python block of README, and of other verbs, as a person sees them in a terminal.

    python benchmarks/speed/readme.py [--out results/readme.json]

Everything runs in the order of README, in an empty folder, with one thread and a terminal. Skipped are ``make install``, which
``install.py`` measures, and the page of play, which does not end. Silence is the longest time without a byte on the terminal.
"""

import argparse
import json
import os
import pty
import re
import resource
import select
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from ftl_lightning.services.tensor_file import write_text

README, TABLE = Path("README.md"), Path("results/readme.md")
PYTHON = "python -m ftl_lightning "
SKIPPED = ("play",)
"""Verbs that do not end."""
OTHERS = (
    'generate navigation --task "go to red bowl" --count 5 --out red.safetensors',
    "invert navigation red.safetensors --out red",
    "explain --concept red/go_to_red_bowl.safetensors",
    "concepts navigation",
    "check red.safetensors",
    "check five.npz --pretrained logs/own/fit/pretrained --learn true",
    'sample --pretrained navigation --compose "go to bowl:1" --goal "go to bowl" --count 50 --execute true',
    'sample --pretrained driving --compose "merge:1" --goal merge --count 10 --execute true',
    'sample --pretrained tabletop --compose "pick green circle to book:1" --goal "pick green circle to book" --count 50'
    " --execute true",
    "invert --config conf/object_rearrangement.yaml",
    "invert --config conf/agent.yaml --evaluation.samples 10",
)
"""Commands of other verbs, after those of README in the same folder."""


def programs(text: str) -> Iterator[tuple[str, list[str]]]:
    """Title and arguments of each command and Python block, in order."""
    for block, line in re.findall(r"^```python\n((?:.*\n)*?)```|^    (python .*)$", text, re.MULTILINE):
        if block:
            shown = [row for row in block.splitlines() if row and not row.startswith(("import", "from"))]
            yield f"Python: `{shown[0].partition('#')[0].strip()[:60]}`", [sys.executable, "-c", block]
        elif line.removeprefix(PYTHON).split()[0] not in SKIPPED:
            words = line.removeprefix(PYTHON)
            yield f"`{words.partition(' --')[0]}`", [sys.executable, "-m", "ftl_lightning", *shlex.split(words)]


def run(arguments: Sequence[str]) -> dict[str, float]:
    """Seconds, processor seconds and longest silence of a program in a terminal."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    child, terminal = pty.fork()
    if not child:
        os.execvpe(arguments[0], [*arguments], os.environ | {"OMP_NUM_THREADS": "1", "TERM": "xterm"})
    last, silence, output = begin, 0.0, b""
    while True:
        ready, _, _ = select.select([terminal], [], [], 1.0)
        if not ready:
            continue
        try:
            read = os.read(terminal, 65536)
        except OSError:  # the end of a terminal
            read = b""
        now = time.perf_counter()
        silence, last = max(silence, now - last), now
        if not read:
            break
        output = (output + read)[-2000:]
    _, status = os.waitpid(child, 0)
    os.close(terminal)
    if status:
        raise SystemExit(f"{shlex.join(arguments)[:200]}\n{output.decode(errors='replace')}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": round(last - begin, 1), "processor": round(processor, 1), "silence": round(silence, 1)}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/readme.json"))
    chosen = parser.parse_args()
    measured, here = dict[str, dict[str, float]](), Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        others = ((f"`{words[:70]}`", [sys.executable, "-m", "ftl_lightning", *shlex.split(words)]) for words in OTHERS)
        for title, arguments in (*programs(README.read_text(encoding="utf-8")), *others):
            os.chdir(here if "report" in arguments else folder)  # which reads results/
            measured[title] = run(arguments)
            os.chdir(here)
            print(title, measured[title], flush=True)
    write_text(chosen.out, json.dumps(measured, indent=1) + "\n")
    rows = [f"| {title} | {row['seconds']} s | {row['processor']} s | {row['silence']} s |" for title, row in measured.items()]
    write_text(TABLE, "\n".join(["| command | seconds | processor seconds | longest silence |", "|---|---|---|---|", *rows]) + "\n")


if __name__ == "__main__":
    main()
