"""Cache of demonstrations that take long to make, in the user's cache folder."""

from collections.abc import Callable, Mapping
from typing import Any

from ftl_lightning.demonstrations.container import Demonstrations
from ftl_lightning.errors import UserError
from ftl_lightning.progress import bar
from ftl_lightning.tensor_file import cache_folder, content_hash

Tell = Callable[[], None]
FORM = 2
"""Version of cached demonstrations; others are not used. Compression of images, added later, did not change it."""


def cached(settings: Mapping[str, Any], total: int, make: Callable[[Tell], Demonstrations]) -> Demonstrations:
    """Read demonstrations from the cache, or make and cache them, with a progress bar.

    Args:
        settings: everything that determines them; their hash with :data:`FORM` names the file.
        total: number of demonstrations.
        make: function that makes them, and calls its argument after each.
    """
    path = cache_folder() / f"{settings['domain']}-{content_hash({**settings, 'form': FORM})}.safetensors"
    if path.is_file():
        try:
            return Demonstrations.load(path)
        except UserError:
            path.unlink()  # of another version of this package, or damaged: made again
    with bar(f"{settings['domain']}: demonstrations", total, lines=total >= SLOW) as advance:
        made = make(advance)
    made.save(path)
    return made


SLOW = 20
"""Minimum number of demonstrations for lines without a terminal."""
