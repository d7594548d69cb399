"""What tests of the command line share."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from en4dvar_bubble.model import BubbleModel
from en4dvar_bubble.starter import guess as starter_guess
from en4dvar_bubble.starter import proposal
from en4dvar_bubble.starter.guess import GRID, Guess, first_guess

GUESSES: dict[bytes, Guess] = {}


@pytest.fixture(scope="module", autouse=True)
def _guessed_once() -> Iterator[None]:
    """What ``init`` guesses of the same bubble is computed once, and on every other node of its grid: of most files
    here, and half of their time.
    """

    def guess(model: BubbleModel, fixed: Mapping[str, float], observed: Mapping[str, float]) -> Guess:
        asked = pickle.dumps((model, sorted(fixed.items()), sorted(observed.items())))
        if asked not in GUESSES:
            GUESSES[asked] = first_guess(model, fixed, observed)
        return GUESSES[asked]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proposal, "first_guess", guess)
        patch.setattr(starter_guess, "GRID", {name: nodes[::2] for name, nodes in GRID.items()})
        yield


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test begins in its own folder."""
    monkeypatch.chdir(tmp_path)
