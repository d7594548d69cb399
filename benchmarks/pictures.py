"""How the pictures of the documentation are taken: its commands are run, and what they leave is photographed."""

from __future__ import annotations

import html
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "configs" / "data"
WIDTH = 1120  # pixels of a page
TERMINAL = (
    "body{margin:0;background:#1e2127;color:#dcdfe4}pre{font:14px/1.45 'DejaVu Sans Mono',monospace;padding:14px 18px;"
    "margin:0;white-space:pre-wrap}"
    "b{color:#98c379;font-weight:normal}"
)


def call(folder: Path, *words: str) -> None:
    """A command of en4dvar, silently; the code of the folder can be imported."""
    command = [sys.executable, "-m", "en4dvar.cli", *words]
    subprocess.run(command, cwd=folder, check=True, env=_environment(folder), stdout=subprocess.DEVNULL)


def typed(folder: Path, line: str) -> str:
    """What a shell says to a line that stands on a page, whatever its exit code."""
    done = subprocess.run(
        line, shell=True, cwd=folder, env=_environment(folder), stdin=subprocess.DEVNULL, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    return done.stdout.replace(f"{folder.resolve()}{os.sep}", "")


def _environment(folder: Path) -> dict[str, str]:
    """``en4dvar`` is this interpreter's, from these sources."""
    program = folder / ".bin" / "en4dvar"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m en4dvar.cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    here = os.environ
    sources = os.pathsep.join([str(folder), str(ROOT), str(ROOT / "models")])
    path = os.pathsep.join([str(program.parent), str(Path(sys.executable).parent), here["PATH"]])
    return {**here, "PYTHONPATH": sources, "PATH": path, "COLUMNS": "100", "XDG_STATE_HOME": str(folder / ".state")}


def files_of(page: str, folder: Path) -> list[list[str]]:
    """Write the files that a page of the documentation shows; its ``en4dvar`` commands."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for name, body in re.findall(r"```(?:python|yaml)\n# ([\w.]+)[^\n]*\n(.*?)```", text, re.S):
        (folder / name).write_text(body, encoding="utf-8")
    return [shlex.split(words, comments=True) for words in re.findall(r"^\$ en4dvar (.*)$", text, re.M)]


def lines_of(page: str, start: str = "") -> list[str]:
    """The lines that a page shows behind a prompt, those that begin so."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return [line for line in re.findall(r"^\$ (.*)$", text, re.M) if line.startswith(start)]


def follow(page: str, folder: Path) -> list[str]:
    """Write the files of a page and type its lines; what was said to each."""
    files_of(page, folder)
    return [typed(folder, line) for line in lines_of(page)]


class Camera:
    """Pictures of pages, terminals and figures of one folder, by a headless Chromium."""

    def __init__(self, browser: Any, folder: Path, pictures: Path, width: int, colours: int):
        self.browser, self.folder, self.pictures = browser, folder, pictures
        self.width, self.colours = width, colours

    def __call__(self, page: str, name: str, height: int, at: str = "", colours: int = 0) -> None:
        """``height`` pixels of a page from its top, or of its element ``at`` (as in CSS)."""
        self.keep(self._shoot((self.folder / page).as_uri(), height, at), name, colours)

    def terminal(self, name: str, lines: Sequence[tuple[str, str]], most: int = 40) -> None:
        """Lines that were typed, and the first ``most`` lines that were said to each."""
        shown = ""
        for line, said in lines:
            body = said.rstrip().splitlines()
            kept = [*body[:most], *(["…"] if len(body) > most else [])]
            shown += f"<b>$ {html.escape(line)}</b>\n" + "".join(f"{html.escape(text)}\n" for text in kept)
        shown = shown.replace("-", "\N{NON-BREAKING HYPHEN}")  # a line is not broken within an option
        page = self.folder / "terminal.html"
        page.write_text(f"<meta charset=utf-8><style>{TERMINAL}</style><pre>{shown}</pre>", encoding="utf-8")
        self.keep(self._shoot(page.as_uri(), 2000, "pre"), name)

    def _shoot(self, address: str, height: int, at: str) -> Image.Image:
        view = self.browser.new_page(viewport={"width": WIDTH, "height": height}, color_scheme="light")
        view.goto(address)
        view.wait_for_timeout(500)
        view.evaluate("at => document.querySelectorAll('details').forEach(d => d.open = !!at)", at)
        box = view.locator(at).first.bounding_box() if at else {"x": 0, "y": 0, "width": WIDTH, "height": height}
        clip = {**box, "height": min(box["height"], height)}
        picture = Image.open(io.BytesIO(view.screenshot(full_page=True, clip=clip)))
        view.close()
        return picture

    def keep(self, picture: Image.Image, name: str, colours: int = 0) -> None:
        """Smaller than it was seen and in few colours: small files."""
        width = min(self.width, picture.width)
        small = picture.convert("RGB").resize(
            (width, picture.height * width // picture.width), Image.Resampling.LANCZOS
        )
        small.quantize(colours or self.colours, dither=Image.Dither.NONE).save(
            self.pictures / f"{name}.png", optimize=True
        )


def take(
    steps: Sequence[Callable[[Path, Camera], None]], words: Sequence[str], width: int = 900, colours: int = 64
) -> None:
    """Every step (or those named behind the folder of the pictures) in a folder of its own; ``width`` in pixels."""
    from playwright.sync_api import sync_playwright

    pictures = Path(words[0]) if words else ROOT / "docs" / "assets"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        for step in steps:
            if not words[1:] or step.__name__ in words[1:]:
                with tempfile.TemporaryDirectory() as name:
                    step(Path(name), Camera(browser, Path(name), pictures, width, colours))
        browser.close()
