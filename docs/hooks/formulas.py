"""Formulas become MathML while the site is built: browsers draw it themselves, without script, font or network."""

from __future__ import annotations

import logging
import re
import unicodedata
from html import unescape
from typing import Any

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.formulas")
_TIGHT = re.compile(r"<mo([^>]*)>(/|&#x0002F;|\||&#x0007C;|&#x02223;)</mo>")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.S)


_FUNCTION = re.compile(r"(<mi>(?:ln|log|exp|cos|sin|det)</mi>)(?=<m(?:i|n|frac|sqrt|sub|sup)>)")
_STYLED = re.compile(r'<(m[in]) mathvariant="(script|double-struck|bold)">(\w)</\1>')
_STYLES = {"script": "SCRIPT CAPITAL", "double-struck": "DOUBLE-STRUCK CAPITAL", "bold": "MATHEMATICAL BOLD"}


def _styled(match: re.Match[str]) -> str:
    """A letter of its own in place of a style, which browsers no longer read."""
    tag, style, letter = match.groups()
    kind = "DIGIT" if letter.isdigit() else "CAPITAL" if style == "bold" else ""
    try:
        made = unicodedata.lookup(" ".join(filter(None, [_STYLES[style], kind, unicodedata.name(letter).split()[-1]])))
    except KeyError:
        return match.group()
    return f'<{tag} mathvariant="normal">{made}</{tag}>'


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Replace what ``pymdownx.arithmatex`` marked; a formula not understood is a warning, so a strict build fails."""

    def mathml(match: re.Match[str]) -> str:
        tag, bracket, source = match.groups()
        tex = unescape(source).strip()
        try:
            made = convert(tex, display="block" if bracket == "[" else "inline")
        except Exception as error:  # the library raises a dozen classes of its own, and IndexError
            log.warning("%s: formula %r: %r", page.file.src_path, tex, error)
            return match.group()
        if "\\" in re.sub(r'alttext="[^"]*"', "", made):  # a command it does not know is copied as it is
            log.warning("%s: formula %r has a command that is not understood", page.file.src_path, tex)
        made = _STYLED.sub(_styled, made)
        made = _FUNCTION.sub(r'\1<mspace width="0.17em"/>', made)
        made = _TIGHT.sub(r'<mo\1 lspace="0" rspace="0">\2</mo>', made)  # browsers set these apart like a plus
        return f'<{tag} class="formula">{made}</{tag}>'

    return _FORMULA.sub(mathml, html)
