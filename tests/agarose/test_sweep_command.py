"""``en4dvar sweep``: its files and its folder of chunks."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from en4dvar.plumbing.errors import OutputError
from en4dvar_agarose.checkpoints import prepare_folder
from en4dvar_agarose.commands import sweep as sweep_command

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_folder_of_another_sweep(tmp_path):
    prepare_folder(tmp_path, "a", "new")
    (tmp_path / "design_00000.npz").write_bytes(b"")
    with pytest.raises(OutputError, match="--resume"):
        prepare_folder(tmp_path, "a", "new")
    with pytest.raises(OutputError, match="another configuration"):
        prepare_folder(tmp_path, "b", "resume")
    assert prepare_folder(tmp_path, "a", "resume") == tmp_path
    prepare_folder(tmp_path, "b", "force")
    assert not list(tmp_path.glob("*.npz"))


def test_command(tmp_path):
    call = [str(CONFIGS / "quickstart.yaml"), "--trajectories", "128", "--out", str(tmp_path), "--step", "0.1 us"]
    first = CliRunner().invoke(sweep_command, call)
    assert first.exit_code == 0, first.output
    assert "NRMSE" in first.output
    table = (tmp_path / "sweep.csv").read_text().splitlines()
    assert table[0] == "dataset,G (kPa),alpha,mu (Pa s),R0 (um),t_s (us),NRMSE"
    assert len(table) == 2
    assert isinstance(CliRunner().invoke(sweep_command, call).exception, OutputError)
    assert CliRunner().invoke(sweep_command, [*call, "--resume"]).exit_code == 0
    assert CliRunner().invoke(sweep_command, [*call, "--force", "--resume"]).exit_code == 2
    assert CliRunner().invoke(sweep_command, [*call, "--shift", "1 kPa"]).exit_code == 2
