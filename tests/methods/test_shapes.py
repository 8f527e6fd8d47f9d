"""Tensors of a wrong shape from a method are one clear line."""

import pytest
import torch
from torch import Tensor

from ftl_lightning import FewShot
from ftl_lightning.evaluation.generation import Generation, generate, tasks_of
from ftl_lightning.igm.settings import Loss
from ftl_lightning.methods.bc import CloningModel
from ftl_lightning.services.errors import UserError


def test_errors_have_one_number_for_each_window(monkeypatch: pytest.MonkeyPatch) -> None:
    model = FewShot.from_pretrained("baseline/bc/object_rearrangement")
    monkeypatch.setattr(CloningModel, "errors", lambda self, states, observed, concepts: torch.zeros(()))
    with pytest.raises(UserError, match=r"methods\.bc\.CloningModel\.errors: expected errors \(4,\), found \(\)"):
        model.model.losses(torch.zeros(4, 1, 9), {}, model.model.compositions(slice(0, 1)), None, Loss(kind="clean"))


def test_samples_have_a_dimension_of_compositions(monkeypatch: pytest.MonkeyPatch) -> None:
    few_shot = FewShot.from_pretrained("baseline/bc/object_rearrangement")
    model = few_shot.model

    class Module:
        concepts = ()
        domain = few_shot.domain

        def __init__(self) -> None:
            self.model = model

        def composition(self, task: object) -> object:
            return few_shot[few_shot.training_concepts[0]]

        def demonstrated(self, concept: str) -> None:
            return None

    def flat(*_: object) -> Tensor:
        return torch.zeros(2, 1, 9)

    monkeypatch.setattr(type(model), "sample", flat)
    tasks = tasks_of(few_shot.domain, ("training",), ())[:1]
    with pytest.raises(UserError, match=r"CloningModel\.sample: expected plans \(1, 2, 1, \d+\), found \(2, 1, 9\)"):
        generate(Module(), tasks, Generation(samples=2))  # type: ignore[arg-type]
