"""The container of demonstrations and its file."""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.errors import UserError
from ftl_lightning.tensor_file import content_hash, load_tensors, save_tensors

KIND = "demonstrations"


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of one or several tasks, in the domain's units.

    Attributes:
        states: ``(demo, time, state)`` float32, padded behind each demonstration's length with its last state.
        lengths: ``(demo,)`` int64, between 1 and ``time``.
        domain: name of the domain, or ``''`` where the file did not say.
        state_names, state_units: one entry a column of ``states``.
        concepts: one text a demonstration; ``''`` where it is not known.
        initial_states: ``(demo, time, initial state)`` float32, what a plan that starts at that time is conditioned on;
            ``(demo, initial state)`` if it is known for the first time alone; or ``None`` where the domain has none.
        provenance: how they came about (generator, seed, ...), anything JSON can hold.

    Raises:
        UserError: at construction, if shapes or values are not as described.
    """

    states: Tensor
    lengths: Tensor
    domain: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    concepts: tuple[str, ...]
    initial_states: Tensor | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.states.dim() != 3 or self.states.dtype != torch.float32:
            raise UserError(
                f"key 'states': expected float32 of shape (demo, time, state), found {self.states.dtype} {tuple(self.states.shape)}"
            )
        count, time, state = self.states.shape
        if not count:
            raise UserError("key 'states': expected at least one demonstration, found none")
        if self.lengths.shape != (count,) or self.lengths.min() < 1 or self.lengths.max() > time:
            raise UserError(f"key 'lengths': expected {count} values between 1 and {time}, found {self.lengths.tolist()}")
        for key, values, expected in (
            ("state_names", self.state_names, state),
            ("state_units", self.state_units, state),
            ("concepts", self.concepts, count),
        ):
            if len(values) != expected:
                raise UserError(f"key {key!r}: expected {expected} entries, found {len(values)}")
        for key, tensor in (("states", self.states), ("initial_states", self.initial_states)):
            if tensor is not None and not bool(torch.isfinite(tensor).all()):
                where = (~torch.isfinite(tensor)).nonzero()[0].tolist()
                raise UserError(f"key {key!r}: expected finite numbers, found {tensor[tuple(where)].item()} at index {where}")
        initial = self.initial_states
        if initial is not None and (initial.dim() not in (2, 3) or initial.shape[:-1] != (count, time)[: initial.dim() - 1]):
            raise UserError(
                f"key 'initial_states': expected shape ({count}, initial state) or ({count}, {time}, initial state), "
                f"found {tuple(initial.shape)}"
            )

    def __len__(self) -> int:
        return len(self.states)

    def select(self, concept: str) -> Self:
        """The demonstrations of one concept."""
        return self.rows([index for index, text in enumerate(self.concepts) if text == concept])

    def rows(self, chosen: Sequence[int]) -> Self:
        """Some of the demonstrations."""
        return replace(
            self,
            states=self.states[chosen],
            lengths=self.lengths[chosen],
            concepts=tuple(self.concepts[row] for row in chosen),
            initial_states=None if self.initial_states is None else self.initial_states[chosen],
        )

    def starts(self, rows: Tensor, share: Tensor, early: float) -> Tensor:
        """Times at which windows start ``(window,)`` int64; 0 where only a demonstration's first initial state is known.

        Args:
            rows: ``(window,)`` int64, which demonstration.
            share: ``(window,)``, evenly spread over [0, 1). To the power of ``early`` it is the share of the demonstration before
                the window.
            early: 1 or more; with 3 half of the windows start in the first eighth.
        """
        if self.initial_states is not None and self.initial_states.dim() == 2:
            return torch.zeros_like(rows)
        return (share**early * self.lengths[rows]).long()

    def windows(self, rows: Tensor, starts: Tensor, horizon: int) -> tuple[Tensor, Tensor | None]:
        """Stretches of demonstrations, padded with the last state.

        Args:
            rows: ``(window,)`` int64, which demonstration.
            starts: ``(window,)`` int64, the first time of each.
            horizon: their length.

        Returns:
            States ``(window, horizon, state)`` and what a plan that starts there is conditioned on, ``(window, initial state)``
            or ``None``.
        """
        times = (starts[:, None] + torch.arange(horizon)).clamp(max=self.states.shape[1] - 1)
        initial = self.initial_states
        if initial is not None:
            initial = initial[rows, starts] if initial.dim() == 3 else initial[rows]
        return self.states[rows[:, None], times], initial

    @property
    def first_initial_states(self) -> Tensor | None:
        """What a plan from each demonstration's start is conditioned on ``(demo, initial state)``, or ``None``."""
        initial = self.initial_states
        return initial[:, 0] if initial is not None and initial.dim() == 3 else initial

    def named(self, concept: str) -> Self:
        """The same, with a name for the concept of those that have none."""
        return replace(self, concepts=tuple(text or concept for text in self.concepts))

    @property
    def hash(self) -> str:
        """16 hexadecimal digits that states, lengths and initial states decide."""
        initial = None if self.initial_states is None else self.initial_states.tolist()
        return content_hash([self.states.tolist(), self.lengths.tolist(), initial])

    def save(self, path: str | Path) -> None:
        """Write one safetensors file with a JSON header, whole or not at all."""
        tensors = {"states": self.states, "lengths": self.lengths}
        if self.initial_states is not None:
            tensors["initial_states"] = self.initial_states
        header = {
            "domain": self.domain,
            "state_names": self.state_names,
            "state_units": self.state_units,
            "concepts": self.concepts,
            "provenance": dict(self.provenance),
        }
        save_tensors(path, KIND, tensors, header)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by :meth:`save`, or an ``.npz`` file without objects.

        An ``.npz`` needs ``states``; ``lengths`` (all full), ``initial_states``, ``concepts`` (empty), ``domain``, ``state_names``
        and ``state_units`` are optional.

        Raises:
            UserError: naming the file, if it is missing, damaged, of another kind, or its content is not as described.
        """
        path = Path(path)
        tensors, header = _read_npz(path) if path.suffix == ".npz" else load_tensors(path, KIND)
        if "states" not in tensors:
            raise UserError(f"{path}: key 'states': expected (demo, time, state), found only {', '.join(tensors) or 'nothing'}")
        states = tensors["states"]
        demos, time, columns = states.shape if states.dim() == 3 else (0, 0, 0)
        try:
            return cls(
                states=states,
                lengths=tensors.get("lengths", torch.full((demos,), time)),
                domain=str(header.get("domain", "")),
                state_names=tuple(header.get("state_names", map(str, range(columns)))),
                state_units=tuple(header.get("state_units", ("",) * columns)),
                concepts=tuple(header.get("concepts", ("",) * demos)),
                initial_states=tensors.get("initial_states"),
                provenance=header.get("provenance", {}),
            )
        except UserError as error:
            raise UserError(f"{path}: {error}") from None


def concatenate(parts: Sequence[Demonstrations]) -> Demonstrations:
    """Demonstrations of the same domain one after another, padded to the longest; the first one's provenance is kept."""
    first = parts[0]
    longest = max(part.states.shape[1] for part in parts)
    initial = [_padded(part.initial_states, longest) for part in parts if part.initial_states is not None]
    return replace(
        first,
        states=torch.cat([_padded(part.states, longest) for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        concepts=tuple(text for part in parts for text in part.concepts),
        initial_states=torch.cat(initial) if initial else None,
    )


def _padded(values: Tensor, time: int) -> Tensor:
    """``(demo, time, column)`` with its last time repeated; what is known for the first time alone stays as it is."""
    if values.dim() == 2:
        return values
    return torch.cat((values, values[:, -1:].expand(-1, time - values.shape[1], -1)), dim=1)


def _read_npz(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if not path.is_file():
        raise UserError(f"{path}: expected a demonstrations file, found nothing")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path}: expected an .npz of plain arrays, found a damaged one or one with objects ({error})") from error
    numeric = {name: array for name, array in arrays.items() if array.dtype.kind in "fiu"}
    tensors = {
        name: torch.from_numpy(np.ascontiguousarray(array, dtype=np.int64 if name == "lengths" else np.float32))
        for name, array in numeric.items()
    }
    texts = {name: array.tolist() for name, array in arrays.items() if array.dtype.kind == "U"}
    # One text stands for all demonstrations.
    if isinstance(texts.get("concepts"), str) and "states" in tensors:
        texts["concepts"] = [texts["concepts"]] * len(tensors["states"])
    header: dict[str, Any] = texts
    return tensors, header
