"""The page of ``play``: one answer with its style and its program in it, which loads nothing."""

import base64
import json
import re
from pathlib import Path
from typing import Any

from ftl_lightning.web import FILM

HERE = Path(__file__).parent
SCRIPTS = (FILM, *(HERE / f"{name}.js" for name in ("space", "films", "ask", "record", "learn", "mix", "viewer", "page")))
"""Parts of the page's program in their order; ``page`` starts it."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; base-uri 'none'; form-action 'none'"
)
"""What every page may do: run its own program, and load nothing."""


def page(nonce: str, offline: bytes | None = None) -> str:
    """The page as HTML.

    Args:
        nonce: of its style and program; letters and digits. Whoever serves the page sends a content security policy with it.
        offline: gzip of a JSON object of answers by :func:`request_key`, for a page that asks no program: ``/api/state``,
            thumbnails and samples. Such a page has its :data:`POLICY` in itself.
    """
    meta = f'<meta http-equiv="Content-Security-Policy" content="{POLICY.format(nonce=nonce)}">\n'
    parts = {
        "STYLE": (HERE / "page.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join(path.read_text(encoding="utf-8") for path in SCRIPTS),
        "NONCE": nonce,
        "CSP": "" if offline is None else meta,
        "OFFLINE": "" if offline is None else base64.b64encode(offline).decode(),
    }
    template = (HERE / "page.html").read_text(encoding="utf-8")
    return re.sub(f"%({'|'.join(parts)})%", lambda found: parts[found[1]], template)


def request_key(path: str, body: Any = None) -> str:
    """The name of a request among answers that were made before, as the page itself makes it.

    Args:
        path: such as ``/api/thumbnail?id=c1``.
        body: of a POST; its keys in the order of the page's. Whole numbers are written without a point, as in JavaScript.
    """
    if body is None:
        return path
    return f"{path} {json.dumps(_whole(body), separators=(',', ':'), ensure_ascii=False)}"


def _whole(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _whole(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_whole(one) for one in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
