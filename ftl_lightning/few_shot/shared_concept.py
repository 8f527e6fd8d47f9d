"""Models and concepts that are shared: a concept's folder with its card and pictures, and the Hugging Face Hub.

Only the concept's file is read, as numbers and texts. The card is for people; if a concept belongs to another model, the card's
name of that model is shown as text.
"""

import io
import json
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import InitialStates, moved
from ftl_lightning.domains.domain import Domain
from ftl_lightning.evaluation.pictures import captioned, gif
from ftl_lightning.few_shot.plans import episodes
from ftl_lightning.few_shot.tuned import ModelSettings
from ftl_lightning.igm.composition import Composition, space_of
from ftl_lightning.igm.concept import Concept
from ftl_lightning.igm.library import CONCEPT, summary
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.files import read_text
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.shipped import FOLDERS
from ftl_lightning.services.tensor_file import atomic, write_text
from ftl_lightning.services.text import counted, line, markdown, markdown_item
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_config import CONFIG
from ftl_lightning.training.model_folder import save_model

CARD, FILM, PICTURE, DEMONSTRATIONS = "README.md", "film.gif", "picture.png", "demonstrations.safetensors"
MOST_BYTES = 1_000_000
"""Maximum size of a film or picture in bytes."""
MOST_CARD = 64 * 2**10
"""Maximum size of a card in bytes."""
SAMPLES = 8
"""Number of samples in a picture."""
_MODEL = re.compile(r'^  model: "([^"\n]{1,200})"$', re.MULTILINE)


def write_folder(
    folder: Path,
    model: ConceptModel,
    concept: Concept,
    tuned: ModelSettings,
    known_as: str = "",
    demonstrations: Demonstrations | None = None,
) -> None:
    """Write the folder of a concept; an existing card is kept.

    Args:
        known_as: public name of the model; empty for none.
        demonstrations: demonstrations to include; ``None`` for none.
    """
    concept.save(folder / CONCEPT)
    shown = _film(model, concept, tuned)
    if shown is not None:
        name, content = shown
        with atomic(folder / name) as temporary:
            temporary.write_bytes(content)
    if demonstrations is not None:
        demonstrations.save(folder / DEMONSTRATIONS)
    if not (folder / CARD).is_file():
        write_text(folder / CARD, card(folder / CONCEPT, known_as, shown[0] if shown else "", demonstrations is not None))


def read_folder(folder: Path, name: str, space: str) -> Concept:
    """Read the concept of a shared folder; ``UserError`` without a concept, or for another model's concept, with that model.

    Args:
        folder: local or downloaded folder.
        space: concept space of the model, see :func:`~ftl_lightning.igm.composition.space_of`.
    """
    concept = Concept.load(folder / CONCEPT)
    if (owner := space_of(concept.origin.domain, concept.origin.pretrained)) != space:
        called = _model_of(folder / CARD)
        label = f", which its card calls {called!r}" if called else ""
        raise UserError(
            f"{short(name, 80)}: expected a concept of this model, {space}, found one of {short(owner, 60)}{label}; load that model"
        )
    return concept


def _model_of(path: Path) -> str:
    """A card's name of the concept's model; empty for an invalid card."""
    try:
        match = _MODEL.search(read_text(path, "Markdown", MOST_CARD).partition("\n---")[0])
    except UserError:
        return ""
    return "" if match is None else short(line(match[1]), 60)


def card(path: Path, known_as: str, shown: str, with_demonstrations: bool) -> str:
    """Card with the Hub's metadata; ``UserError`` for a file that is not a concept.

    Args:
        known_as: public name of the model; empty for none.
        shown: file name of the film or picture; empty for none.
        with_demonstrations: whether the folder includes demonstrations.
    """
    content = summary(path)
    if content is None:
        raise UserError(f"{path}: expected a concept file, found another file")
    origin, quality, model = content.origin, content.quality, known_as or "FOLDER OR NAME OF THE MODEL"
    keys = {"concept": origin.name, **({"model": known_as} if known_as else {}), "hash": origin.pretrained, "domain": origin.domain}
    # JSON strings are valid YAML; ``line`` has replaced unprintable characters, which YAML refuses.
    quoted = {key: json.dumps(line(value), ensure_ascii=False) for key, value in keys.items()}
    metadata = "".join(f"  {key}: {value}\n" for key, value in quoted.items())
    base = f"base_model: {quoted['model']}\n" if known_as.count("/") == 1 else ""  # on the Hub, which refuses other names
    rows = {
        "model": f"{f'{known_as}, ' if known_as else ''}domain {origin.domain}, hash {origin.pretrained}; it works with no other",
        "learned from": f"{counted(origin.count, 'demonstration')} (hash {origin.demonstrations})",
        "form": f"{content.form}; {origin.weights} guidance weights; loss {origin.loss:.4f}",
        "quality": "not measured",
    }
    if quality is not None:
        right = "" if quality.right is None else f"{quality.metric} {quality.right:.2f}, "
        numbers = f"spread {quality.spread:.2f}, relative novelty {quality.novelty:.2f}, roughness {quality.roughness:.2f}"
        rows["quality"] = f"{right}{numbers} ({counted(quality.samples, 'sample')}, started like the demonstrations)"
    files = {CONCEPT: "the concept, numbers and texts alone", shown: "what it generates"}
    files |= {DEMONSTRATIONS: "what it was learned from"} if with_demonstrations else {}
    listed = "\n".join(f"- `{name}`: {what}" for name, what in files.items() if name)
    table = "\n".join(f"| {key} | {markdown(value)} |" for key, value in rows.items())
    return (
        "---\nlibrary_name: ftl-lightning\ntags: [few-shot-learning, diffusion, imitation-learning, learned-concept]\n"
        f"{base}ftl_lightning:\n{metadata}---\n# {markdown(origin.name)}\n\n"
        "A concept that was learned from a few demonstrations through a generative model.\n\n"
        f"{f'![what it generates]({shown})' if shown else ''}\n\n| | |\n|---|---|\n{table}\n\n"
        "    from ftl_lightning import FewShot\n"
        f"    model = FewShot.from_pretrained({json.dumps(line(model))})\n"
        '    concept = model.load("FOLDER OR NAME")\n\n'
        f"{listed}\n"
    )


def _film(model: ConceptModel, concept: Concept, tuned: ModelSettings) -> tuple[str, bytes] | None:
    """File name and content of a film or picture of samples; ``None`` without initial states.

    Initial states are new, so that no demonstration is shown.
    """
    domain, name = model.domain, concept.origin.name
    starts = _starts(domain, name, SAMPLES)
    if domain.observed and starts is None:
        return None
    composition = concept.composition.to(model.device)
    if (frames := _frames(model, composition, tuned, starts)) and (content := small(captioned(frames, name))):
        return FILM, content
    plans = _plans(model, composition, tuned, starts, SAMPLES)
    figure = domain.show.picture(plans, None, name, starts if domain.observed else None)
    for dpi in (110, 80, 50):
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=dpi)
        if len(file.getvalue()) <= MOST_BYTES:
            return PICTURE, file.getvalue()
    return None


def _frames(
    model: ConceptModel, concept: Composition, tuned: ModelSettings, starts: InitialStates | None
) -> list[NDArray[np.uint8]]:
    """Frames of a plan, or else of an episode; empty without films or the simulator."""
    domain, loop = model.domain, model.domain.closed_loop
    if domain.show.film is not None:
        return domain.show.film(_plans(model, concept, tuned, starts, 1)[0])
    if loop is None or loop.film is None or starts is None or starts.scenes is None:
        return []
    try:
        loop.expect()
        rollout, followed = episodes(model, loop, concept, starts.take([0]), tuned.sampling, tuned.replan, 0)
        return loop.film(rollout, torch.stack(list(followed[0]))) if followed.get(0) else []
    except UserError:  # a picture needs no simulator
        return []


def _plans(
    model: ConceptModel, concept: Composition, tuned: ModelSettings, starts: InitialStates | None, count: int
) -> torch.Tensor:
    features = {} if starts is None else moved(starts.take(slice(0, count)).observed, model.device)
    return model.sample([concept], count, tuned.sampling, [generator("cpu", 0)], features)[0].cpu()


def _starts(domain: Domain, name: str, count: int) -> InitialStates | None:
    """New initial states of a task, or of the first training concept if the domain cannot read the name."""
    if not domain.observed:
        return None
    task = next((text for text in (name, *domain.concepts.training) if domain.concepts.reads(text)), "")
    try:
        return domain.source(None).starts(task, count, 0)
    except (UserError, KeyError, ValueError, IndexError):  # a third-party source
        return None


def small(frames: Sequence[NDArray[np.uint8]]) -> bytes:
    """Animation of at most :data:`MOST_BYTES`, with fewer frames and colours if necessary; empty if it cannot fit."""
    for each, colours in ((1, 64), (2, 64), (4, 32), (8, 16)):
        if len(content := gif(frames[::each], colours=colours)) <= MOST_BYTES:
            return content
    return b""


MODEL_FILES = ("*.json", "*.safetensors", "*.md")
"""Files to download from a model's repository."""
CONCEPT_FILES = (CONCEPT, "README.md")
"""Files to download from a concept's repository."""
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


def is_repository(name: str) -> bool:
    """Whether a name may be ``'owner/name'`` on the Hub; paths such as ``'./a'`` and ``'conf/a'`` never are."""
    owner, slash, rest = name.partition("/")
    return bool(slash) and "/" not in rest and owner not in FOLDERS and not owner.startswith((".", "~"))


def download(
    repository: str, files: Sequence[str] = MODEL_FILES, expected: str = "a folder, a model that ships or one on the Hub"
) -> Path:
    """Download the model or concept ``owner/name``, or take it from the cache, and return its folder.

    Raises:
        UserError: if the download fails.
    """
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repository, allow_patterns=[*files]))
    except Exception as error:  # the Hub, the network and the cache raise kinds of their own
        raise UserError(f"{repository}: expected {expected}, found none ({_reason(error)})") from error


def upload(write: Callable[[Path], object], repository: str, private: bool = False) -> str:
    """Upload a folder as ``owner/name`` and return its address; ``UserError`` for an invalid name or a failed upload.

    Args:
        write: writes the files into a folder; not called for an invalid name.
        private: whether a new repository is private.
    """
    if not isinstance(repository, str) or not _REPOSITORY.fullmatch(repository):
        raise UserError(f"repository: expected a name on the Hub, such as 'owner/name', found {shown(repository)}")
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        from huggingface_hub import HfApi

        hub = HfApi()
        try:
            hub.create_repo(repository, private=private, exist_ok=True)
            return str(hub.upload_folder(repo_id=repository, folder_path=folder))
        except Exception as error:
            message = f"{repository}: expected a place on the Hub that you may write to, found none ({_reason(error)})"
            raise UserError(f"{message}; log in first: hf auth login") from error


def _reason(error: Exception) -> str:
    return short(str(error).splitlines()[0] if str(error) else type(error).__name__, 100)


def model_card(model: ConceptModel) -> str:
    """Model card with the Hub's metadata; names come from files, so they are escaped."""
    config = model.config
    texts = "\n".join(f"- {markdown_item(text)}" for text in config.training_concepts)
    title = f"{markdown(model.method.name)} on {markdown(model.domain.name)}"
    return (
        "---\nlibrary_name: ftl-lightning\ntags: [few-shot-learning, diffusion, imitation-learning]\n---\n"
        f"# {title}\n\nHash {model.hash}; plans of {config.horizon} states of "
        f"{config.state_dim} numbers. Text encoder: {markdown(config.encoder)}.\n\nTraining concepts:\n\n{texts}\n\n"
        '```python\nfrom ftl_lightning import FewShot\nmodel = FewShot.from_pretrained("FOLDER OR NAME")\n```\n\n'
        f"Files: `{CONFIG}`, `model.safetensors` (weights in half precision).\n"
    )


def save_with_card(model: ConceptModel, folder: Path) -> None:
    """Write a model's folder, and a ``README.md`` unless it exists."""
    save_model(model, folder)
    if not (readme := folder / "README.md").is_file():
        with atomic(readme) as temporary:
            temporary.write_text(model_card(model), encoding="utf-8")
