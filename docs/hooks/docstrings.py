"""The project's docstrings as Markdown, while mkdocstrings reads them.

Sections are underlined words with one ``name: text`` an item; roles such as ``:func:`run``` name Python objects.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

_SECTION = re.compile(r"^(Parameters|Raises|Returns|Attributes|Notes|Sources)\n-{3,}$", re.M)
_ITEM = re.compile(r"^(?=[\w*]+(?:, [\w*]+)*: )", re.M)
_EXAMPLE = re.compile(r"^>>> .*(?:\n(?!\n).+)*", re.M)  # up to an empty line
_ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc):`[~.]*([^`<]+)`")


class Docstrings(Extension):
    """Rewrites each docstring once, before it is rendered."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(text: str) -> str:
    """A docstring as Markdown.

    >>> markdown("Do it.\\n\\nRaises\\n------\\nValueError: never.\\nOSError: see\\n    :func:`a.b`.")
    'Do it.\\n\\n**Raises**\\n\\n- `ValueError`: never.\\n- `OSError`: see\\n    `a.b`.\\n'
    """
    text = _EXAMPLE.sub(r"```pycon\n\g<0>\n```", _ROLE.sub(r"`\1`", text))
    head, *rest = _SECTION.split(text)
    parts = [head.rstrip()]
    for title, body in zip(rest[::2], rest[1::2], strict=True):
        section, blank, after = body.strip("\n").partition("\n\n")
        # several items may stand on one line, as in "ConfigError: why. OSError: why."
        section = re.sub(r"\. (?=[A-Z]\w*Error: )", ".\n", section) if title == "Raises" else section
        items = [item.strip() for item in _ITEM.split(section) if item.strip()]
        listed = "\n".join(re.sub(r"^([\w*]+(?:, [\w*]+)*): ", r"- `\1`: ", item) for item in items)
        parts.append(f"**{title}**\n\n{listed}\n{blank}{after}")
    return "\n\n".join(parts)
