"""What a hand does on the page, and what it waits for."""

from __future__ import annotations

import re
import shlex
import subprocess

import pytest
from run_files import command

LONG = 240_000  # ms: a command of a step


def until(page, expression):
    """Wait until an expression of JavaScript is true; Playwright's own way is what the page's policy forbids."""
    for _ in range(LONG // 100):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{expression} is never true; the page says: {page.inner_text('#message')}")


def done(page, step, ended="done"):
    """Click a step and wait for its end; the words of its command."""
    page.click(f"button[data-step={step}]")
    box = {"prior": "validate", "resume": "run", "export": "compare"}.get(step, step)
    page.wait_for_selector(f"#job-{box}.running", timeout=LONG)
    page.wait_for_selector(f"#job-{box}.{ended}", timeout=LONG)
    return words_of(page, box)


def words_of(page, box):
    """The words of the command that a box of the page prints."""
    return shlex.split(re.search(r"^\$ en4dvar (.*)$", page.inner_text(f"#job-{box} pre"), re.M)[1])


def point_of(page, frame):
    """Where the reading of a frame is on the canvas of R(t)."""
    point = page.evaluate(f"document.getElementById('history').points.find((p) => p.frame === {frame})")
    return {"x": point["left"], "y": point["top"]}


def repeat(folder, *commands):
    for words in commands:
        subprocess.run(command(*words), cwd=folder, check=True, capture_output=True)


def proposed(page, table, **fields):
    """Choose columns and units of a table ("": of the one that is chosen), and propose a model."""
    if table:
        page.select_option("#table", table)
    for key, value in fields.items():
        select = key.endswith("column")
        (page.select_option if select else page.fill)(f"#{key.replace('_', '-')}", value)
    words = done(page, "init")
    until(page, "document.getElementById('text').value !== ''")
    return words


def at(page, x, y):
    """Where a place in the frame, pixels, is on the canvas."""
    box = page.evaluate("(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(frame)")
    return {"x": x * box[0] / page.evaluate("movie.width"), "y": y * box[1] / page.evaluate("movie.height")}


def require_accessible(page):
    """What axe-core, a checker of others, finds wrong with the page as it is now: nothing."""
    axe = pytest.importorskip("axe_playwright_python.base")
    page.evaluate(axe.AXE_FILE_PATH.read_text(encoding="utf-8"))
    judged = page.evaluate("axe.run()")
    assert len(judged["passes"]) > 20
    faults = [(fault["id"], [node["html"] for node in fault["nodes"]]) for fault in judged["violations"]]
    assert not faults, faults
