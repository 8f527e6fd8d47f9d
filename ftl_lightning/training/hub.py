"""Models and concepts on the Hugging Face Hub; requires a network."""

import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from ftl_lightning.igm.library import CONCEPT
from ftl_lightning.services.errors import UserError, short, shown
from ftl_lightning.services.shipped import FOLDERS
from ftl_lightning.services.tensor_file import atomic
from ftl_lightning.services.text import markdown, markdown_item
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_config import CONFIG
from ftl_lightning.training.model_folder import save_model

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


def card(model: ConceptModel) -> str:
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
            temporary.write_text(card(model), encoding="utf-8")
