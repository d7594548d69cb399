"""HTML pages from templates: one style, one script, no address outside the file; everything given is escaped."""

import base64
import hashlib
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from markupsafe import Markup

from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.hints import counted, percent
from en4dvar.report import responses, text
from en4dvar.report.chart import DARK, LIGHT
from en4dvar.report.svg import Captioned, draw

WRITERS = (  # what templates call
    text.display_unit, text.estimate, text.fixed, text.in_powers, text.number_like, percent, text.plain_number,
    text.plus_minus, text.pretty_unit, text.quantity, text.range_words, text.rough_number, text.shown, text.symbol_html,
    text.untrusted_words, responses.sentence, responses.shift_text, counted,
)  # fmt: skip


def write_page(
    folder: Path, name: str, figures: Iterable[Captioned], copies: Path | None = None, /, **content: Any
) -> Path:
    """Write ``name.html`` from our template of that name, with ``figures``, whose ``copies`` as PDF and PNG go into a
    folder, if any. Raises :class:`OutputError`.
    """
    page = render(f"{name}.html.j2", figures=draw(figures, folder=copies), **content)
    return write_text(folder / f"{name}.html", page)


def render(template: str, package: str = "en4dvar.report", /, **content: Any) -> str:
    """The page of a template of a package as text; of ours with the scripts of charts and of tables that are sorted. A
    content security policy forbids it every address and every script but these: what escaping might miss would not run.

    A template of an application gets the colours on ``light`` and on ``dark`` ground. Raises :class:`LookupError`: the
    content lacks what the page shows.
    """
    try:
        return _environment(package).get_template(template).render(**content)
    except UndefinedError as error:  # a file with a good seal may lack what the page shows
        raise LookupError(str(error).rpartition(" has ")[2]) from None


@cache
def _environment(package: str) -> Environment:
    environment = Environment(loader=PackageLoader(package, "."), autoescape=True, undefined=StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters |= {"upper_first": text.upper_first, "with_symbols": text.with_symbols}
    environment.filters |= {"without_folders": text.without_folders, "typeset": text.typeset}
    script = _text("table.js") + _text("chart.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    grounds = (" ".join(f"--{name}: {code};" for name, code in colours.items()) for colours in (LIGHT, DARK))
    light, dark = map(Markup, grounds)
    palette = f":root {{ {light} }}\n@media screen and (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
    style = Markup(palette + _text("style.css"))
    environment.globals |= {"policy": policy, "style": style, "script": Markup(script), "light": light, "dark": dark}
    environment.globals |= {write.__name__: write for write in WRITERS}
    return environment


def _text(name: str) -> str:
    return files("en4dvar.report").joinpath(name).read_text(encoding="utf-8")
