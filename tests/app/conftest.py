"""Servers of the page, ended after the tests of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from clicking import until
from page_server import Server, start

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def serve() -> Iterator[Callable[..., Server]]:
    """``serve(folder, *options)``."""
    pytest.importorskip("tornado")
    servers = []

    def started(folder: Path, *options: str) -> Server:
        servers.append(start(folder, *options))
        return servers[-1]

    yield started
    for server in servers:
        server.end()


@pytest.fixture
def visit(browser, serve):
    """``visit(folder)``: a page on a server of its own; a complaint of the browser fails the test."""
    contexts, complaints = [], []

    def opened(server, width=1280, prepare=lambda page: None):
        contexts.append(browser.new_context(viewport={"width": width, "height": 900}))
        page = contexts[-1].new_page()
        prepare(page)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: complaints.append(r.url) if "127.0.0.1" not in r.url[:30] else None)
        page.goto(f"http://127.0.0.1:{server.port}{server.secret}")
        until(page, "state !== null")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert [words for words in complaints if not words.startswith(("data:", "blob:"))] == []


@pytest.fixture
def two_bubbles(tmp_path):
    """A folder with a movie of two bubbles side by side, and their centres (2, 2)."""
    tifffile = pytest.importorskip("tifffile")
    from nasty_movies import film

    filmed = film("side by side, pointed at", 0)
    tifffile.imwrite(tmp_path / "two.tif", np.array(filmed.frames))
    return tmp_path, np.nanmedian(filmed.centre, axis=1)


@pytest.fixture
def german(tmp_path):
    """A folder with a table as a German spreadsheet writes it."""
    lines = (ROOT / "configs" / "data" / "agarose_synthetic.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if not line.startswith("#")][1:]
    folder = tmp_path / "tables"
    folder.mkdir()
    text = "Zeit;Radius\n" + "".join(f"{t};{r}\n".replace(".", ",") for t, r in rows)
    (folder / "messung.csv").write_text(text, encoding="utf-8")
    return folder
