"""The container of demonstrations and its file."""

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from ftl_lightning.demonstrations.features import Feature, InitialStates, Observed, take
from ftl_lightning.errors import UserError, about, short, shown
from ftl_lightning.limits import MOST_TENSORS, expect_readable, expect_unpacked
from ftl_lightning.representation import Shown, counted
from ftl_lightning.schema import expect_type
from ftl_lightning.tensor_file import bytes_hash, load_tensors, save_tensors, serialise

KIND = "demonstrations"
VERSION = 3
"""Of the form of a file with images: they are compressed (zlib), 1-D uint8 under their keys, with their shapes by key in the header
as ``compressed``. Forms 1 and 2 still load."""
PLAIN = 2
"""The form of a file without images. Older files of this form hold images that are not compressed; form 1 had ``initial_states`` in
place of observed features and scenes."""
_OBSERVED = "observed/"
"""Before the names of observed features in a file."""
INITIAL = "initial_state"
"""The observed feature that the initial states of form 1 become."""
MOST_SHRUNK = 1032
"""zlib makes one byte of so many at most."""


@dataclass(frozen=True, repr=False)
class Demonstrations(Shown):
    """Demonstrations of one or several tasks, in the domain's units.

    Attributes:
        states: ``(demo, time, state)`` float32, padded behind each demonstration's length.
        lengths: ``(demo,)`` int64, between 1 and ``time``.
        domain: name of the domain, or ``''`` where the file did not say.
        state_names, state_units: one entry a column of ``states``.
        concepts: one text a demonstration; ``''`` where it is not known.
        observed: observed features by name: ``(demo, time, *shape)`` of those in ``per_step``, what a plan that starts at that time
            is conditioned on; ``(demo, *shape)`` of the others, known for the first time alone. Vectors are float32, images uint8.
        per_step: names of the features that are known at every time.
        scenes: ``(demo, scene)`` float32, what resets the environment to each demonstration's start and what a judge reads, never
            shown to a model; ``None`` where there is nothing of the kind.
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
    observed: Observed = field(default_factory=dict)
    per_step: tuple[str, ...] = ()
    scenes: Tensor | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.states.dim() != 3 or self.states.dtype != torch.float32:
            raise UserError(
                f"key 'states': expected float32 of shape (demo, time, state), found {self.states.dtype} {tuple(self.states.shape)}"
            )
        count, time, state = self.states.shape
        if not count:
            raise UserError("key 'states': expected at least one demonstration, found none")
        if not time or not state:
            raise UserError(f"key 'states': expected at least one time and column, found none in {tuple(self.states.shape)}")
        if self.lengths.dtype != torch.int64:
            raise UserError(f"key 'lengths': expected whole numbers (int64), found {self.lengths.dtype}")
        if self.lengths.shape != (count,) or self.lengths.min() < 1 or self.lengths.max() > time:
            found = shown(self.lengths.flatten()[:20].tolist())
            raise UserError(f"key 'lengths': expected {count} values between 1 and {time}, found {found}")
        for key, values, expected in (
            ("state_names", self.state_names, state),
            ("state_units", self.state_units, state),
            ("concepts", self.concepts, count),
        ):
            if len(values) != expected:
                raise UserError(f"key {key!r}: expected {expected} entries, found {len(values)}")
        if unknown := set(self.per_step) - set(self.observed):
            raise UserError(f"key 'per_step': expected names of observed features, found {short(', '.join(sorted(unknown)))}")
        for name, feature in self.observed.items():
            leading = (count, time) if name in self.per_step else (count,)
            if tuple(feature.shape[: len(leading)]) != leading or feature.dim() <= len(leading):
                told = ", ".join(map(str, leading))
                raise UserError(f"key 'observed/{name}': expected shape ({told}, ...), found {tuple(feature.shape)}")
            if feature.dtype not in (torch.float32, torch.uint8):
                found = str(feature.dtype).removeprefix("torch.")
                raise UserError(f"key 'observed/{name}': expected float32, or uint8 for images, found {found}")
        if self.scenes is not None and (self.scenes.dim() != 2 or len(self.scenes) != count):
            raise UserError(f"key 'scenes': expected shape ({count}, scene), found {tuple(self.scenes.shape)}")
        if self.scenes is not None and self.scenes.dtype != torch.float32:
            raise UserError(f"key 'scenes': expected float32, found {self.scenes.dtype}")
        for key, tensor in self.tensors.items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                where = (~torch.isfinite(tensor)).nonzero()[0].tolist()
                raise UserError(f"key {key!r}: expected finite numbers, found {tensor[tuple(where)].item()} at index {where}")

    def __len__(self) -> int:
        return len(self.states)

    def _words(self) -> Iterator[str]:
        if self.domain:
            yield repr(self.domain)
        yield f"states {tuple(self.states.shape)}"
        shortest, longest = int(self.lengths.min()), int(self.lengths.max())
        if shortest < self.states.shape[1]:
            yield f"lengths {shortest} to {longest}"
        if any(self.concepts):
            yield repr(self.concepts[0]) if len(set(self.concepts)) == 1 else counted(len(set(self.concepts)), "concept")
        for name, values in self.observed.items():
            yield f"{name} {tuple(values.shape)}"
        if self.scenes is not None:
            yield f"scenes {tuple(self.scenes.shape)}"

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Everything that is one, by its key in a file."""
        scenes = {} if self.scenes is None else {"scenes": self.scenes}
        features = {_OBSERVED + name: values for name, values in self.observed.items()}
        return {"states": self.states, "lengths": self.lengths} | features | scenes

    @property
    def features(self) -> dict[str, Feature]:
        """Shape and kind of each observed feature."""
        return {name: Feature.of(values, leading=2 if name in self.per_step else 1) for name, values in self.observed.items()}

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
            observed=take(self.observed, chosen),
            scenes=None if self.scenes is None else self.scenes[chosen],
        )

    def starts(self, rows: Tensor, share: Tensor, exponent: float, horizon: int, at_rest: bool = True) -> Tensor:
        """Times at which windows start ``(window,)`` int64.

        Where features are observed at every time, a plan can start at any; 0 where one is known for the first time alone. Where
        nothing is observed, nothing tells a plan where in a behaviour it is: then windows stay within a demonstration, and one as
        long as it starts at 0.

        Args:
            rows: ``(window,)`` int64, which demonstration.
            share: ``(window,)``, evenly spread over [0, 1).
            exponent: u of ``start = length * share^u``; 1 is uniform, with 3 half of the windows start in the first eighth.
            horizon: length of the windows.
            at_rest: whether windows may reach past the end; else they stay within demonstrations that are long enough.
        """
        if set(self.observed) - set(self.per_step):
            return torch.zeros_like(rows)
        past = bool(self.observed) and at_rest
        room = self.lengths[rows] if past else (self.lengths[rows] - horizon + 1).clamp(min=1)
        return (share**exponent * room).long()

    def windows(self, rows: Tensor, starts: Tensor, horizon: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Stretches of demonstrations, padded with the last state.

        Args:
            rows: ``(window,)`` int64, which demonstration.
            starts: ``(window,)`` int64, the first time of each.
            horizon: their length.

        Returns:
            States ``(window, horizon, state)`` and what is observed where each starts, by name ``(window, *shape)``.
        """
        times = (starts[:, None] + torch.arange(horizon)).clamp(max=self.states.shape[1] - 1)
        seen = {name: values[rows, starts] if name in self.per_step else values[rows] for name, values in self.observed.items()}
        return self.states[rows[:, None], times], seen

    @property
    def initial_states(self) -> InitialStates:
        """Where each demonstration starts."""
        first = {name: values[:, 0] if name in self.per_step else values for name, values in self.observed.items()}
        return InitialStates(first, self.scenes)

    @property
    def every_observation(self) -> dict[str, Tensor]:
        """What is observed at all times of all demonstrations, by name ``(observation, *shape)``."""
        return {name: values.flatten(0, 1) if name in self.per_step else values for name, values in self.observed.items()}

    def named(self, concept: str) -> Self:
        """The same, with a name for the concept of those that have none."""
        return replace(self, concepts=tuple(text or concept for text in self.concepts))

    @property
    def hash(self) -> str:
        """16-digit hash of states, lengths, observed features and scenes, whatever the form of a file that holds them."""
        return bytes_hash(serialise(KIND, self.tensors, {}))

    def save(self, path: str | Path) -> None:
        """Write one safetensors file with a JSON header, whole or not at all; images are compressed, see :data:`VERSION`."""
        images = {_OBSERVED + name: values for name, values in self.observed.items() if values.dtype == torch.uint8}
        packed = {key: _packed(values) for key, values in images.items()}
        header = {
            "domain": self.domain,
            "state_names": self.state_names,
            "state_units": self.state_units,
            "concepts": self.concepts,
            "per_step": self.per_step,
            "provenance": dict(self.provenance),
            **({"compressed": {key: list(values.shape) for key, values in images.items()}} if images else {}),
        }
        save_tensors(path, KIND, self.tensors | packed, header, VERSION if images else PLAIN)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by :meth:`save`, or an ``.npz`` file without objects.

        An ``.npz`` needs ``states`` ``(demo, time, state)``; ``concepts`` (texts, or one for all), ``lengths`` (all full),
        ``state_names``, ``state_units``, ``domain``, ``scenes`` and observed features as ``observed/NAME`` are optional. Names
        listed in ``per_step`` are observed at every time.

        Raises:
            UserError: naming the file, if it is missing, damaged, of another kind, or its content is not as described.
        """
        path = Path(path)
        tensors, header = _read_npz(path) if path.suffix == ".npz" else load_tensors(path, KIND, (1, PLAIN, VERSION))
        with about(path):
            if "states" not in tensors:
                told = short(", ".join(tensors)) or "nothing"
                raise UserError(f"key 'states': expected (demo, time, state), found only {told}")
            states = tensors["states"]
            demos, time, columns = states.shape if states.dim() == 3 else (0, 0, 0)
            texts = {key: _texts(key, header[key]) for key in _TEXTS if key in header}
            per_step, scenes = texts.get("per_step", ()), tensors.get("scenes")
            if header.get("format") == VERSION and demos:
                tensors |= _unpacked(tensors, header.get("compressed"), per_step)
            observed = {name.removeprefix(_OBSERVED): values for name, values in tensors.items() if name.startswith(_OBSERVED)}
            if (initial := tensors.get("initial_states")) is not None:  # form 1
                observed, per_step = {INITIAL: initial}, (INITIAL,) if initial.dim() == 3 else ()
                scenes = initial[:, 0] if initial.dim() == 3 else initial
            return cls(
                states=states,
                lengths=tensors.get("lengths", torch.full((demos,), time)),
                domain=expect_type(header.get("domain", ""), str, "domain"),
                state_names=texts.get("state_names", tuple(map(str, range(columns)))),
                state_units=texts.get("state_units", ("",) * columns),
                concepts=texts.get("concepts", ("",) * demos),
                observed=observed,
                per_step=per_step,
                scenes=scenes,
                provenance=expect_type(header.get("provenance", {}), Mapping[str, Any], "provenance"),
            )

    def fitted(self, features: Mapping[str, Feature]) -> Self:
        """The same with the observed features of a domain.

        The initial states of form 1 hold them one after another; what follows them is what no model sees.

        Args:
            features: of the domain, by name.

        Raises:
            UserError: for a feature that is missing or has another type or shape.
        """
        found = self
        if set(self.observed) == {INITIAL} and INITIAL not in features and features:
            values, per_step = self.observed[INITIAL], bool(self.per_step)
            sizes = [feature.size for feature in features.values()]
            if values.shape[-1] < sum(sizes):
                raise UserError(f"key 'initial_states': expected {sum(sizes)} numbers each or more, found {values.shape[-1]}")
            parts = values[..., : sum(sizes)].split(sizes, dim=-1)
            observed = {
                name: part.unflatten(-1, feature.shape).contiguous()
                for (name, feature), part in zip(features.items(), parts, strict=True)
            }
            found = replace(self, observed=observed, per_step=tuple(features) if per_step else ())
        for name, feature in features.items():
            if (own := found.features.get(name)) is None or not own.fits(feature):
                told = "none" if own is None else own.words
                if own is not None and own.shape[1:] == feature.shape and name not in found.per_step:
                    told += " (observed at every time? then list it in per_step)"
                raise UserError(f"key 'observed/{name}': expected {feature.words} each, found {told}")
        return found


def concatenate(parts: Sequence[Demonstrations]) -> Demonstrations:
    """Demonstrations of the same domain one after another, padded to the longest; the first one's provenance is kept.

    A feature is observed at every time, and there are scenes, where that is so of all parts.
    """
    first = parts[0]
    longest = max(part.states.shape[1] for part in parts)
    per_step = tuple(name for name in first.per_step if all(name in part.per_step for part in parts))
    scenes = [part.scenes for part in parts if part.scenes is not None]
    return replace(
        first,
        states=torch.cat([_padded(part.states, longest) for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        concepts=tuple(text for part in parts for text in part.concepts),
        observed={
            name: torch.cat(
                [
                    _padded(part.observed[name], longest) if name in per_step else part.initial_states.observed[name]
                    for part in parts
                ]
            )
            for name in first.observed
        },
        per_step=per_step,
        scenes=torch.cat(scenes) if len(scenes) == len(parts) else None,
    )


def padded(behaviours: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Behaviours of different lengths as one tensor.

    Args:
        behaviours: ``(time, ...)`` each, of at least one time.

    Returns:
        ``(demo, longest time, ...)``, each padded with its last time, and the lengths ``(demo,)`` int64.
    """
    lengths = torch.tensor([len(one) for one in behaviours])
    longest = int(lengths.max())
    return torch.cat([_padded(one[None], longest) for one in behaviours]), lengths


def _padded(values: Tensor, time: int) -> Tensor:
    """``(demo, time, ...)`` with its last time repeated."""
    last = values[:, -1:].expand(-1, time - values.shape[1], *(-1,) * (values.dim() - 2))
    return torch.cat((values, last), dim=1)


_TEXTS = ("state_names", "state_units", "concepts", "per_step")
"""Keys of a file's header that hold lists of texts."""


def _texts(key: str, found: object) -> tuple[str, ...]:
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
        raise UserError(f"key {key!r}: expected a list of texts, found {shown(found)}")
    return tuple(found)


def _packed(images: Tensor) -> Tensor:
    """Images ``(demo, ...)`` uint8, compressed as one ``(byte,)``."""
    return torch.frombuffer(bytearray(zlib.compress(images.detach().cpu().numpy().tobytes())), dtype=torch.uint8)


def _unpacked(tensors: Mapping[str, Tensor], shapes: object, per_step: Sequence[str]) -> dict[str, Tensor]:
    """The images of a file whose header names their shapes, by key.

    What they need in memory is bounded: their shapes begin as that of the states, and nothing beyond them is decompressed.

    Args:
        tensors: as they are in the file; states ``(demo, time, state)`` among them.
        shapes: by key, as the header says.
        per_step: names of features that are known at every time.

    Raises:
        UserError: naming the key, if its shape is none that it can have, or its bytes are damaged.
    """
    if not isinstance(shapes, dict):
        raise UserError(f"key 'compressed': expected shapes of images by key, found {shown(shapes)}")
    found = {}
    for key, shape in shapes.items():
        packed = tensors.get(key)
        if packed is None or not key.startswith(_OBSERVED) or packed.dtype != torch.uint8 or packed.dim() != 1:
            told = "nothing" if packed is None else f"{str(packed.dtype).removeprefix('torch.')} of shape {tuple(packed.shape)}"
            expected = "compressed images, uint8 of shape (byte,) under 'observed/NAME'"
            raise UserError(f"key {short(key)!r}: expected {expected}, found {told}")
        leading = list(tensors["states"].shape[: 2 if key.removeprefix(_OBSERVED) in per_step else 1])
        numbers = isinstance(shape, list) and all(type(size) is int and size >= 0 for size in shape)
        if not numbers or shape[: len(leading)] != leading or math.prod(shape) > MOST_SHRUNK * len(packed):
            begin = ", ".join(map(str, leading))
            raise UserError(
                f"key {key!r}: expected images of shape ({begin}, ...) that fit into {len(packed)} compressed bytes, "
                f"found the shape {shown(shape)} in the header; the file is damaged"
            )
        with about(f"key {short(key)!r}"):
            expect_unpacked(math.prod(shape), len(packed), "images")
        content = _decompressed(key, packed.numpy().tobytes(), math.prod(shape))
        found[key] = torch.from_numpy(np.frombuffer(content, dtype=np.uint8)).reshape(shape)
    return found


def _decompressed(key: str, packed: bytes, size: int) -> bytearray:
    reader = zlib.decompressobj()
    try:
        content = bytearray(reader.decompress(packed, size + 1))  # one more: room to meet the end
    except zlib.error as error:
        raise UserError(f"key {key!r}: expected compressed images, found damaged bytes ({error}); take another copy") from error
    if len(content) != size or not reader.eof or reader.unused_data:
        more = len(content) > size or reader.unused_data
        told = "more" if more else f"{len(content)}{'' if reader.eof else ' and no end'}"
        raise UserError(f"key {key!r}: expected {size} bytes of images, found {told}; the file is damaged: take another copy")
    return content


def _read_npz(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    size = expect_readable(path, "demonstrations")
    try:
        expect_arrays(path, size)
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
            texts = {name: array.tolist() for name, array in arrays.items() if array.dtype.kind == "U"}
        "".join(text for value in texts.values() for text in np.ravel(value)).encode()
    except (*_DAMAGED, zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError) as error:
        told = short(str(error), 100)
        raise UserError(f"{path}: expected an .npz of plain arrays, found a damaged one or one with objects ({told})") from error
    tensors = {}
    for name, array in arrays.items():
        measured = name.startswith(_OBSERVED) or name in ("states", "lengths", "scenes")
        if (measured and array.dtype.kind not in "fiub") or (name in (*_TEXTS, "domain") and array.dtype.kind != "U"):
            told = "numbers" if measured else "texts"
            raise UserError(f"{path}: key {short(name)!r}: expected an array of {told}, found one of {short(str(array.dtype))}")
        if array.dtype.kind in "fiub":
            # Images stay bytes; everything else that is measured is float32.
            image = array.dtype == np.uint8 and name.startswith(_OBSERVED)
            kind = np.uint8 if image else np.int64 if name == "lengths" and array.dtype.kind in "iu" else np.float32
            with np.errstate(over="ignore"):  # what is too large for float32 is told as no finite number
                tensors[name] = torch.from_numpy(np.array(array, dtype=kind, order="C", ndmin=array.ndim))
    for name, value in texts.items():
        if isinstance(value, str):
            # One text stands for all demonstrations.
            several = name == "concepts" and "states" in tensors and tensors["states"].dim()
            texts[name] = [value] * len(tensors["states"]) if several else [value]
    header: dict[str, Any] = dict(texts)
    if len(texts.get("domain", ())) == 1:
        header["domain"] = texts["domain"][0]
    return tensors, header


_DAMAGED = (OSError, ValueError, EOFError, AttributeError, TypeError, RuntimeError, LookupError, MemoryError, SyntaxError)
"""What numpy and zipfile raise for files that are damaged or none of theirs."""


def expect_arrays(path: Path, size: int) -> None:
    """Refuse an archive that is much larger than its file, or holds an array whose header names another size than its bytes have.

    Raises:
        ValueError: saying so.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MOST_TENSORS:
            raise ValueError(f"{len(members)} arrays")
        with about(path):
            expect_unpacked(sum(member.file_size for member in members), size, "arrays")
        for member in members:
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
                stated = math.prod(shape) * dtype.itemsize
                if not dtype.hasobject and (min(shape, default=0) < 0 or stated != member.file_size - file.tell()):
                    raise ValueError(f"{member.filename} is not of the size that it says")
