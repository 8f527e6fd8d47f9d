"""Cache of demonstrations that take long to make, in the user's cache folder."""

from collections.abc import Callable, Mapping
from typing import Any

from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.formats.file_format import VERSION
from ftl_lightning.services.errors import UserError
from ftl_lightning.services.progress import bar
from ftl_lightning.services.tensor_file import cache_folder, content_hash

Tell = Callable[[], None]


def cached(settings: Mapping[str, Any], total: int, make: Callable[[Tell], Demonstrations]) -> Demonstrations:
    """Read demonstrations from the cache, or make and cache them, with a progress bar.

    Args:
        settings: everything that determines them; their hash with the version of the file format names the file.
        total: number of demonstrations.
        make: function that makes them, and calls its argument after each.
    """
    path = cache_folder() / f"{settings['domain']}-{content_hash({**settings, 'format': VERSION})}.safetensors"
    if path.is_file():
        try:
            return Demonstrations.load(path)
        except UserError:
            path.unlink(missing_ok=True)  # damaged; another process may have removed the file
    with bar(f"{settings['domain']}: demonstrations", total, lines=total >= SLOW) as advance:
        made = make(advance)
    made.save(path)
    return made


SLOW = 20
"""Minimum number of demonstrations for lines without a terminal."""
