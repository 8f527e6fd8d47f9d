"""Models on the Hugging Face Hub; all that is done there needs a network."""

from pathlib import Path

from ftl_lightning.errors import UserError
from ftl_lightning.learning.concept_model import ConceptModel
from ftl_lightning.learning.model_config import CONFIG
from ftl_lightning.learning.model_folder import save_model
from ftl_lightning.tensor_file import atomic


def download(repository: str) -> Path:
    """The folder of the model ``owner/name``, downloaded now or before.

    Raises:
        UserError: if it cannot be had.
    """
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repository, allow_patterns=["*.json", "*.safetensors", "*.md"]))
    except Exception as error:  # the Hub, the network and the cache raise kinds of their own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{repository}: expected a folder, a model that ships or one on the Hub, found none ({reason})") from error


def upload(folder: str | Path, repository: str, private: bool = False) -> str:
    """Upload a model's folder as ``owner/name``; needs a login.

    Returns:
        Where it is.
    """
    from huggingface_hub import HfApi

    hub = HfApi()
    hub.create_repo(repository, private=private, exist_ok=True)
    return str(hub.upload_folder(repo_id=repository, folder_path=folder))


def card(model: ConceptModel) -> str:
    """A short model card with the Hub's metadata."""
    texts = "\n".join(f"- {text}" for text in model.config.training_concepts)
    return (
        "---\nlibrary_name: ftl-lightning\ntags: [few-shot-learning, diffusion, imitation-learning]\n---\n"
        f"# {model.method.name} on {model.domain.name}\n\nHash {model.hash}; plans of {model.config.horizon} states of "
        f"{model.config.state_dim} numbers. Text encoder: {model.config.encoder}.\n\nTraining concepts:\n\n{texts}\n\n"
        f'    from ftl_lightning import FewShot\n    model = FewShot.from_pretrained("FOLDER OR NAME")\n\n'
        f"Files: `{CONFIG}`, `model.safetensors` (weights in half precision).\n"
    )


def save_with_card(model: ConceptModel, folder: Path) -> None:
    """Write a model's folder and, if there is none yet, a ``README.md`` into it."""
    save_model(model, folder)
    if not (readme := folder / "README.md").is_file():
        with atomic(readme) as temporary:
            temporary.write_text(card(model), encoding="utf-8")
