"""Nothing on a page is loaded from elsewhere: the theme's one remote script is replaced by the copy in ``assets``."""

from __future__ import annotations

import logging
import re
from typing import Any

from mkdocs.utils import get_relative_url

log = logging.getLogger("mkdocs.hooks.no_network")
_SHIM = "https://unpkg.com/iframe-worker/shim"
_LOADED = re.compile(
    r"<(?:script|img|iframe|source|link(?! rel=.canonical))[^>]+(?:src|href)=[\"']?(https?://[^\"' >]+)"
)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The page with local addresses; one that still loads something from elsewhere is a warning."""
    return _local(output, page.url, page.file.src_path)


def on_post_template(output_content: str, template_name: str, **_: Any) -> str:
    """The same for the page of an address that does not exist."""
    return _local(output_content, template_name, template_name) if template_name.endswith(".html") else output_content


def _local(html: str, url: str, name: str) -> str:
    html = html.replace(_SHIM, get_relative_url("assets/iframe-worker.js", url))
    for address in _LOADED.findall(html):
        log.warning("%s: loads %s", name, address)
    return html
