"""``en4dvar sweep``: its files and its folder of chunks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import en4dvar
from en4dvar.model.state import Parameter
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.sampling.sweep import SweepResult
from en4dvar_agarose.commands import sweep as sweep_command
from en4dvar_agarose.tables import sweep_text

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_command(tmp_path):
    call = [str(CONFIGS / "quickstart.yaml"), "--trajectories", "128", "--out", str(tmp_path), "--step", "0.1 us"]
    first = CliRunner().invoke(sweep_command, call)
    assert first.exit_code == 0, first.output
    assert "NRMSE" in first.output
    assert "given twice" in CliRunner().invoke(sweep_command, [call[0], *call]).output
    with pytest.raises(OutputError, match=r"holds sweep\.csv of another command; give another directory"):
        en4dvar.run(call[0], overrides={"output.directory": str(tmp_path)}, resume=True)
    table = (tmp_path / "sweep.csv").read_text().splitlines()
    assert table[0] == "dataset,G (kPa),alpha,mu (Pa s),R0 (um),t_s (us),NRMSE"
    assert len(table) == 2
    assert isinstance(CliRunner().invoke(sweep_command, call).exception, OutputError)
    assert CliRunner().invoke(sweep_command, [*call, "--width", "inf"]).exit_code == 2
    other = [*call, "--width", "2"]
    changed = CliRunner().invoke(sweep_command, [*other, "--resume"]).exception
    assert isinstance(changed, OutputError)
    assert "-  width: 3.0\n+  width: 2.0" in str(changed)
    assert CliRunner().invoke(sweep_command, [*call, "--resume"]).exit_code == 0
    assert (tmp_path / "sweep.csv").read_text().splitlines() == table
    assert isinstance(CliRunner().invoke(sweep_command, [*call, "--force", "--resume"]).exception, ConfigError)
    assert CliRunner().invoke(sweep_command, [*other, "--force"]).exit_code == 0
    assert CliRunner().invoke(sweep_command, [*call, "--shift", "1 kPa"]).exit_code == 2


def test_mean_and_spread_have_the_same_decimals():
    """It read "G = 8.059 ± 3.4 kPa" and "R0 = 0.8405 ± 0.9 um"."""
    G, shift = Parameter("G", "Pa", label="shear modulus", display_unit="kPa"), np.zeros(2)
    both = SweepResult(("a", "b"), (G,), np.array([[4659.0], [11459.0]]), shift, np.full(2, 0.9), 1)
    assert "  shear modulus: G = 8.1 ± 3.4 kPa\n" in sweep_text(both)
    assert "  shear modulus: G = 4.659 kPa\n" in sweep_text(both.part(slice(1)))
