"""The notebooks of the documentation: every cell runs, in order, in an empty folder, and the truth is found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from doc_pages import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def session(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that the code cells of a notebook leave."""
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    for cell in json.loads((ROOT / "docs" / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    import matplotlib.pyplot as plt  # every worker reads the head of this file, and this takes a second

    plt.close("all")
    return names


def test_there_are_three_of_them_without_stored_results() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["first_bubble", "many_bubbles", "own_model"]
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert not any(cell.get("outputs") for cell in cells)


@pytest.mark.slow
def test_a_first_bubble(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = session("first_bubble", tmp_path, monkeypatch)["result"].summary()
    for name, truth in {"G": 0.42, "mu": 0.086}.items():
        assert abs(table.loc[name, "mean"] - truth) < 3 * table.loc[name, "std"]
    assert table.loc["mu", "std"] < 0.3 * table.loc["mu", "prior_std"]


@pytest.mark.slow
def test_many_bubbles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = session("many_bubbles", tmp_path, monkeypatch)
    assert len(names["campaign"]) == 6
    median = names["gel"].set_index("dataset").loc["median of the population"]
    assert median["q05"] < 8 < median["q95"]


@pytest.mark.slow
def test_a_model_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = session("own_model", tmp_path, monkeypatch)
    table = names["result"].summary()
    for name, truth in names["truth"].items():
        assert abs(table.loc[name, "mean"] - truth) < 3 * table.loc[name, "std"]
        assert table.loc[name, "std"] < 0.3 * table.loc[name, "prior_std"]
