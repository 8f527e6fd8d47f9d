"""Runs notebooks again and keeps what they show, without what differs from one run to the next.

    python notebooks/execute.py                           # all of them, after results, models or reports have changed
    python notebooks/execute.py notebooks/concepts.ipynb  # some

A notebook runs in a temporary folder with links to the folders of the checkout that notebooks read, so that it writes nothing into
the checkout, and on one thread, so that computed numbers do not depend on the number of cores. ``tests/test_notebooks.py`` runs
them in the same way and compares. What a cell shows is to be the same to the digit, unless the cell has one of these tags:

``rounding``
    computed with a model: on another processor the last digit of a number may differ.
``varies``
    learned or simulated: on another processor numbers may differ. The cell asserts what must hold.
``skip-execution``
    not run here, such as an installation; nbclient, which runs the others, knows this tag.
"""

import base64
import io
import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

from ftl_lightning.services.tensor_file import write_text

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
READ = ("conf", "pretrained", "results")
"""Folders of the checkout that notebooks read."""
TAGS = ("rounding", "varies", "skip-execution")
COLOURS = 128
LONGEST = 600
"""Seconds that a cell may take."""


def notebooks() -> list[Path]:
    """All that are kept, in the order in which they are read."""
    return sorted(path for path in HERE.rglob("*.ipynb") if ".ipynb_checkpoints" not in path.parts)


def executed(path: Path, folder: Path) -> NotebookNode:
    """A notebook with what its cells show when they are run one after another.

    Args:
        path: of the notebook, which stays as it is.
        folder: where it runs; links to the folders that it reads are added where nothing of that name is there.

    Returns:
        The notebook without times, versions and standard error, which goes to this process's own.

    Raises:
        CellExecutionError: with the cell and its error.
    """
    notebook = nbformat.read(path, as_version=4)
    for name in READ:
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    client = NotebookClient(
        notebook, timeout=LONGEST, record_timing=False, coalesce_streams=True, resources={"metadata": {"path": str(folder)}}
    )
    with tempfile.TemporaryDirectory() as profile:  # neither the user's start-up files nor their history
        client.execute(env=os.environ | _environment(profile))
    for cell in notebook.cells:
        cell.metadata = {"tags": cell.metadata["tags"]} if cell.metadata.get("tags") else {}
        if cell.cell_type == "code":
            cell.outputs = [output for output in map(_smaller, cell.outputs) if not _told(output)]
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python", "pygments_lexer": "ipython3"},
    }
    return notebook


def _environment(profile: str) -> dict[str, str]:
    """Of the kernel: this checkout's package, whatever is installed, and this Python for the commands of cells."""
    return {
        "IPYTHONDIR": profile,
        "OMP_NUM_THREADS": "1",
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}",
        "PYTHONPATH": str(ROOT),
    }


def _told(output: NotebookNode) -> bool:
    """Whether an output is a warning or a log, which is printed here and not kept."""
    if output.get("name") != "stderr":
        return False
    sys.stderr.write(output.text)
    return True


def _smaller(output: NotebookNode) -> NotebookNode:
    """The same output, its picture with fewer colours."""
    if "image/png" in output.get("data", {}):
        content = base64.b64decode(output.data["image/png"])
        picture, file = Image.open(io.BytesIO(content)), io.BytesIO()
        picture.convert("RGB").quantize(COLOURS).save(file, format="PNG", optimize=True)
        if len(file.getvalue()) < len(content):
            output.data["image/png"] = base64.b64encode(file.getvalue()).decode()
    return output


def main(paths: list[str]) -> None:
    """Run some notebooks, or all, and replace each by what it shows now."""
    for path in [Path(name).resolve() for name in paths] or notebooks():
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            found = executed(path, Path(folder))
        write_text(path, nbformat.writes(found) + "\n")
        print(f"{path.name}: {time.monotonic() - began:.0f} s, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
