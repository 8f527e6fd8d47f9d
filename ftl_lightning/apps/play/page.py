"""The page of ``play``: a single document with its style and scripts, which loads nothing."""

import base64
import json
import re
from pathlib import Path
from typing import Any

from ftl_lightning.services.shipped import FILM

HERE = Path(__file__).parent
SCRIPTS = (FILM, *(HERE / f"{name}.js" for name in ("space", "films", "ask", "record", "learn", "mix", "viewer", "page")))
"""Scripts of the page in order; ``page`` starts the program."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of every page: run its scripts, and load nothing."""


def page(nonce: str, offline: bytes | None = None) -> str:
    """The page as HTML.

    Args:
        nonce: nonce of style and scripts; letters and digits. The server sends a content security policy with the page.
        offline: gzip of a JSON object of answers by :func:`request_key`, for a page without a server: ``/api/state``, thumbnails
            and samples. Such a page contains its :data:`POLICY`.
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
    return re.sub(f"%({'|'.join(parts)})%", lambda match: parts[match[1]], template)


def request_key(path: str, body: Any = None) -> str:
    """Key of a request among precomputed answers, as the page computes it.

    Args:
        path: such as ``/api/thumbnail?id=c1``.
        body: body of a POST; keys in the page's order. Whole numbers are written without a point, as in JavaScript.
    """
    if body is None:
        return path
    return f"{path} {json.dumps(_whole(body), separators=(',', ':'), ensure_ascii=False)}"


def _whole(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _whole(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
