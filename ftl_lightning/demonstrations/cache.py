"""A cache of demonstrations that take long to make, in the user's cache folder."""

from collections.abc import Callable, Mapping
from typing import Any

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError
from ftl_lightning.progress import bar
from ftl_lightning.tensor_file import cache_folder, content_hash

Tell = Callable[[], None]
FORM = 2
"""Of demonstrations: what is cached of another one is not used. Compression of images, which came later, changes none."""


def cached(settings: Mapping[str, Any], total: int, make: Callable[[Tell], Demonstrations]) -> Demonstrations:
    """Read demonstrations from the cache, or make them, with a progress bar, and keep them there.

    Args:
        settings: everything that decides them; a file is named by their hash and :data:`FORM`.
        total: how many are made.
        make: makes them; calls its argument after each.
    """
    path = cache_folder() / f"{settings['domain']}-{content_hash({**settings, 'form': FORM})}.safetensors"
    if path.is_file():
        try:
            return Demonstrations.load(path)
        except UserError:
            path.unlink()  # of another version of this package, or damaged from outside: made again
    with bar(f"{settings['domain']}: demonstrations", total, lines=total >= SLOW) as advance:
        made = make(advance)
    made.save(path)
    return made


SLOW = 20
"""So many and more are told in lines where there is no terminal."""
