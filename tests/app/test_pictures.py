"""Frames of a movie in any order, with room for a few of them only."""

from __future__ import annotations

import numpy as np
import pytest

from en4dvar_app import pictures


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_are_the_same_in_any_order_with_little_room(tmp_path, monkeypatch, dtype):
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(3)
    frames = rng.integers(0, np.iinfo(dtype).max, (20, 32, 48)).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", frames)
    monkeypatch.setattr(pictures, "HELD", 4 * frames[0].nbytes)
    opened = pictures.Pictures(tmp_path / "a.tif")
    assert opened.count == 20
    order = [*range(6), 5, 4, 19, 18, 0, *rng.integers(0, 20, 30)]
    seen = [opened.frame(int(n)) for n in order]
    assert np.array_equal(seen, frames[order])
    assert len(opened._room) == 4
