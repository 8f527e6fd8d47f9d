"""Demonstrations in a folder of files, which together may be larger than memory.

A sample of all files decides kinds of columns, scales and validation; training windows come from a few files at a time.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch

from ftl_lightning.data.demonstrations import Demonstrations, concatenate
from ftl_lightning.services.errors import UserError, require
from ftl_lightning.services.files import FILES
from ftl_lightning.services.progress import bar
from ftl_lightning.services.randomness import generator

SAMPLE = 2**24
"""Bytes of the states in the sample, without padding."""
TOGETHER, STEPS = 4, 50
"""Number of files in memory, and of training steps after which one of them is replaced by the next."""
ORDER = 17
"""Seed of the order of the files."""
FEWEST = 2
"""Minimum number of demonstrations of each concept in the sample, where there are as many."""


@dataclass(frozen=True)
class Shards:
    """Files of demonstrations with the same columns and observed features.

    Attributes:
        paths: the files.
        sample: demonstrations of all files, evenly spaced in each, with the longest.
        origins: file and row of each demonstration of the sample.
        sizes: number of demonstrations of each file.
    """

    paths: tuple[str, ...]
    sample: Demonstrations
    origins: tuple[tuple[int, int], ...]
    sizes: tuple[int, ...]

    @classmethod
    def of(cls, folder: str, read: Callable[[str], Demonstrations]) -> "Shards":
        """Read all files of a folder, one at a time.

        Raises:
            UserError: if there are none, or naming the file, if it is damaged or its columns are not those of the first file.
        """
        paths = [str(path) for path in sorted(Path(folder).iterdir()) if path.suffix.lower() in FILES and path.is_file()]
        require(paths, folder, f"files of demonstrations ({', '.join(FILES)})", "none")
        parts, origins, counts, sizes, longest = list[Demonstrations](), list[tuple[int, int]](), dict[str, int](), list[int](), 0
        with bar(f"reading {len(paths)} files of {folder}", len(paths)) as advance:
            for number, path in enumerate(paths):
                demonstrations = read(path)
                if parts:
                    _check_alike(path, demonstrations, paths[0], parts[0])
                rows = _spread(demonstrations, SAMPLE // len(paths), counts, longest)
                longest = max(longest, int(demonstrations.lengths.max()))
                parts.append(demonstrations.rows(rows))
                origins += [(number, row) for row in rows]
                sizes.append(len(demonstrations))
                advance()
        return cls(tuple(paths), concatenate(parts), tuple(origins), tuple(sizes))

    @property
    def about(self) -> str:
        """Number of files and of demonstrations, in words."""
        return f"{sum(self.sizes):,} demonstrations in {len(self.paths):,} files"


def _check_alike(path: str, demonstrations: Demonstrations, first: str, known: Demonstrations) -> None:
    for key, some, other in (
        ("state_names", demonstrations.state_names, known.state_names),
        ("state_units", demonstrations.state_units, known.state_units),
        ("state_kinds", demonstrations.state_kinds, known.state_kinds),
        ("per_step", demonstrations.per_step, known.per_step),
        ("observed", _words(demonstrations), _words(known)),
    ):
        if some != other:
            raise UserError(f"{path}: key {key!r}: expected those of {first}, {list(other)}, found {list(some)}")


def _words(demonstrations: Demonstrations) -> tuple[str, ...]:
    return tuple(f"{name}: {feature.words}" for name, feature in sorted(demonstrations.features.items()))


def _spread(demonstrations: Demonstrations, size: int, counts: dict[str, int], longest: int) -> list[int]:
    """Evenly spaced rows of about ``size`` bytes, one longer than ``longest``, and the first of rare concepts."""
    width = demonstrations.states.shape[2] * demonstrations.states.element_size()
    wanted = min(len(demonstrations), max(1, round(size / (float(demonstrations.lengths.double().mean()) * width))))
    rows = set(torch.linspace(0, len(demonstrations) - 1, wanted).round().long().tolist())
    rows |= {int(demonstrations.lengths.argmax())} if int(demonstrations.lengths.max()) > longest else set()
    for row, text in enumerate(demonstrations.concepts):
        if row in rows or counts.get(text, 0) < FEWEST:
            rows.add(row)
            counts[text] = counts.get(text, 0) + 1
    return sorted(rows)


class Stream:
    """A few files at a time, in an order that depends on the seed alone; the next file is read in the background.

    Args:
        shards: all files.
        read: reads a file.
        excluded: rows of files, by the file's number, that are not for training; a file without others is never read.
    """

    def __init__(
        self, shards: Shards, read: Callable[[str], Demonstrations], excluded: Mapping[int, frozenset[int]], seed: int
    ) -> None:
        self._shards, self._read, self._excluded, self._seed = shards, read, excluded, seed
        self._used = [number for number, size in enumerate(shards.sizes) if len(excluded.get(number, ())) < size]
        self._files: dict[int, Future[Demonstrations]] = {}
        self._reader = ThreadPoolExecutor(1)

    def at(self, step: int) -> list[Demonstrations]:
        """Training demonstrations of the files of a training step."""
        if len(self._used) <= TOGETHER:
            wanted, later = self._used, []
        else:
            place = step // STEPS
            *wanted, last = (self._file(place + offset) for offset in range(TOGETHER + 1))
            later = [last]
        needed = dict.fromkeys([*wanted, *later])
        self._files = {number: self._files.get(number) or self._reader.submit(self._opened, number) for number in needed}
        return [self._files[number].result() for number in dict.fromkeys(wanted)]

    def _file(self, place: int) -> int:
        """Number of the file at a place of the endless order, in which all files come before one comes again."""
        count = len(self._used)
        order = torch.randperm(count, generator=generator("cpu", self._seed, place // count, ORDER))
        return self._used[int(order[place % count])]

    def _opened(self, number: int) -> Demonstrations:
        demonstrations, excluded = self._read(self._shards.paths[number]), self._excluded.get(number, frozenset())
        return (
            demonstrations.rows([row for row in range(len(demonstrations)) if row not in excluded]) if excluded else demonstrations
        )
