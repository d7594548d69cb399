"""Disks that are full or read-only, directories that go away, files that were damaged."""

import errno
import gc
import os
import random
import resource
import shutil
import subprocess
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import xarray as xr
from rows import row
from run_files import assert_same_results, configuration, interrupt, make_campaign, run_cli

from en4dvar.plumbing.errors import OutputError
from en4dvar.report.chart import Chart, Panel, Row
from en4dvar.report.paper import save_chart
from en4dvar.report.result import load_result
from en4dvar.results.netcdf import netcdf_file
from en4dvar.results.pack import PACK, Pack, read_result, results_of
from en4dvar.runs.runner import run_campaign


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quiet")
    path = make_campaign(folder, 2)
    run_campaign(configuration(path, folder / "run", executor="serial"))
    return path, folder / "run"


class Full:
    """The disk takes ``room`` more bytes; files are written whole or in part, as the system does it."""

    def __init__(self, room):
        self.room = room

    def write(self, path, content, before):
        data = content.encode() if isinstance(content, str) else content
        part = data[: max(self.room, 0)]
        self.room -= len(data)
        before(path, part)
        if len(part) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


@pytest.mark.parametrize("room", [500, 3000, 60_000, 125_000])
@pytest.mark.fault("disk-full")
def test_writes_that_fail(quiet, tmp_path, monkeypatch, room):
    """Injected where the operating system is asked to write."""
    path, run = quiet
    disk, write = Full(room), type(path).write_bytes
    config = configuration(path, tmp_path / "run", executor="serial")
    with monkeypatch.context() as patch:
        for name in ("write_bytes", "write_text"):
            patch.setattr(type(path), name, lambda p, content, *_, **__: disk.write(p, content, write))
        with pytest.raises(OutputError) as full:
            run_campaign(config)
    begun = (tmp_path / "run" / "checkpoints" / "run").exists()
    assert row("disk-full").told(str(full.value)) or not begun
    assert "cannot be written: No space left on device" in str(full.value)
    assert not [p for p in (tmp_path / "run").rglob("*") if p.name.endswith(".tmp") or p.name == ".en4dvar-lock"]
    for file in (tmp_path / "run").rglob("*.nc"):
        load_result(file)
    if (tmp_path / "run" / ".en4dvar-files").exists():
        run_campaign(config, resume=True)
        assert_same_results(tmp_path / "run", run)


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.fault("disk-failing")
def test_no_room_for_the_lock(quiet, tmp_path, monkeypatch, capfd):
    """Its file can often be made on a full disk, but not written."""
    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OutputError, match="cannot be used as run directory: No space left on device"):
        run_campaign(configuration(quiet[0], tmp_path / "run", executor="serial"))
    monkeypatch.undo()
    gc.collect()
    assert not (tmp_path / "run").exists()
    assert "ignored" not in capfd.readouterr().err


@pytest.mark.fault("disk-failing")
def test_no_room_for_a_figure(tmp_path, monkeypatch):
    """Whichever way the PDF writer is stopped, it ends in an error of its own."""
    limited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limited[1]))
    try:
        with pytest.raises(OutputError, match=r"a\.pdf: cannot be written: File too large"):
            save_chart(Chart([Row(90.0, [Panel()])]), tmp_path, "a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limited)
    assert not list(tmp_path.iterdir())


@pytest.mark.fault("disk-failing")
def test_no_room_for_a_twin(tmp_path):
    """The netCDF library tells "HDF error"; the operating system's reason is asked for again."""
    limited = resource.getrlimit(resource.RLIMIT_FSIZE)
    data = xr.Dataset({"x": ("t", np.arange(100_000.0))})
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, limited[1]))
    try:
        with pytest.raises(OutputError, match=r"a\.nc: cannot be written: File too large"):  # noqa: SIM117
            with netcdf_file(tmp_path / "a.nc") as partial:
                data.to_netcdf(partial, engine="netcdf4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limited)
    assert not list(tmp_path.iterdir())


@contextmanager
def mounted(folder, options):
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"mount: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can mount")
@pytest.mark.parametrize(
    "size", [60, 140, 250, pytest.param(450, marks=pytest.mark.long)], ids=["begin", "datasets", "campaign", "report"]
)
@pytest.mark.fault("disk-full")
def test_a_small_disk(quiet, tmp_path, size):
    """A real file system without room; what is missing is written once there is."""
    path = make_campaign(tmp_path, 4)
    with mounted(tmp_path / "disk", f"size={size}k") as disk:
        done = run_cli("run", path, "--out", disk / "run")
        assert done.returncode == int(row("disk-full").exit_code), done.stderr
        assert row("disk-full").told(done.stderr)
        assert "Traceback" not in done.stderr
        kept = {p: Pack(p) for p in (disk / "run").rglob(PACK)}
        subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
        done = run_cli("run", path, "--out", disk / "run", "--resume", "--no-report")
        assert done.returncode == 0, done.stderr
        for path_of_pack, before in kept.items():  # what was whole is there, and was not written again
            assert Pack(path_of_pack).entries.items() >= before.entries.items()
        run_campaign(configuration(path, tmp_path / "quiet", executor="serial"))
        assert_same_results(disk / "run", tmp_path / "quiet")


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
@pytest.mark.fault("read-only")
def test_read_only_output(quiet, tmp_path):
    path, _ = quiet
    if os.geteuid() == 0:  # rights do not hold root back, a read-only file system does
        with mounted(tmp_path / "disk", "ro") as disk, pytest.raises(OutputError) as refused:
            run_campaign(configuration(path, disk / "run"))
        assert str(refused.value) == f"{disk}/run: cannot be used as run directory: Read-only file system"
    else:
        (tmp_path / "disk").mkdir(mode=0o500)
        with pytest.raises(OutputError) as refused:
            run_campaign(configuration(path, tmp_path / "disk" / "run"))
        assert row("read-only").told(str(refused.value))
    assert refused.value.exit_code == int(row("read-only").exit_code)


@pytest.mark.parametrize("what", ["removed", "renamed"])
@pytest.mark.fault("removed")
def test_run_directory_removed(quiet, tmp_path, what):
    path, run = quiet
    out, moved = tmp_path / "run", tmp_path / "moved"

    def disturb(*_):
        if out.exists():
            shutil.rmtree(out) if what == "removed" else out.rename(moved)

    with pytest.raises(OutputError) as lost:
        run_campaign(configuration(path, out, executor="serial"), progress=disturb)
    assert row("removed").told(str(lost.value))
    assert not out.exists()
    if what == "renamed":
        run_campaign(configuration(path, moved, executor="serial"), resume=True)
        assert_same_results(moved, run)


def flip(content, draw):
    place = draw.randrange(len(content))
    return content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :]


def overwrite(content, draw):
    place = draw.randrange(len(content) - 4096)
    return content[:place] + draw.randbytes(2048) + content[place + 2048 :]


def cut(content, draw):
    return content[: draw.randrange(len(content))]


def older(content, draw):
    return content.replace(b"\nen4dvar-result 1 ", b"\nen4dvar-result 0 ")


@pytest.mark.parametrize(
    ("damage", "name"),
    [
        pytest.param(flip, "result-damaged", marks=pytest.mark.fault("result-damaged")),
        pytest.param(overwrite, "result-damaged", marks=pytest.mark.fault("result-damaged")),
        pytest.param(cut, "result-cut", marks=pytest.mark.fault("result-cut")),
        pytest.param(older, "result-older", marks=pytest.mark.fault("result-older")),
    ],
)
def test_a_damaged_result_is_named_and_not_read(quiet, tmp_path, damage, name):
    """Without the checksum most of these files are read without a word, and some never end to be read."""
    run, draw = quiet[1], random.Random(3)
    shutil.copytree(run, tmp_path / "run")
    file = tmp_path / "run" / "posterior.nc"
    content = file.read_bytes()
    for _ in range(40):
        file.write_bytes(damage(content, draw))
        with pytest.raises(OutputError) as refused:
            load_result(file)
        assert row(name).told(str(refused.value)) or (damage is flip and row("result-cut").told(str(refused.value)))
        assert str(refused.value).startswith(f"{file}: ")
        if damage is older:
            break
    run_campaign(configuration(quiet[0], tmp_path / "run", executor="serial"), resume=True)
    assert_same_results(tmp_path / "run", run)


def test_no_bit_of_a_pack_can_be_changed_unseen(quiet, tmp_path):
    """Whatever is damaged, a result is what it was or is not read; a resume makes the rest again."""
    run, draw = quiet[1], random.Random(3)
    shutil.copytree(run, tmp_path / "run")
    pack = tmp_path / "run" / PACK
    content, expected = pack.read_bytes(), {a.name: read_result(a) for a in results_of(run / PACK)}
    for i in range(60):
        pack.write_bytes((flip, overwrite, cut)[i % 3](content, draw))
        for address in results_of(pack):
            with suppress(OutputError):
                assert read_result(address) == expected[address.name]
    campaign = run_campaign(configuration(quiet[0], tmp_path / "run", executor="serial"), resume=True)
    assert campaign.exit_code == 0
    assert_same_results(tmp_path / "run", run)


def test_a_pack_of_another_version_is_named(quiet, tmp_path):
    pack = tmp_path / PACK
    pack.write_bytes((quiet[1] / PACK).read_bytes().replace(b"en4dvar-pack 1 ", b"en4dvar-pack 0 "))
    with pytest.raises(OutputError, match=r"datasets\.pack: result format 0; this version of en4dvar reads 1"):
        results_of(pack)


@pytest.mark.parametrize(
    ("damage", "name"),
    [
        pytest.param(flip, "checkpoint-damaged", marks=pytest.mark.fault("checkpoint-damaged")),
        pytest.param(cut, "checkpoint-damaged", marks=pytest.mark.fault("checkpoint-damaged")),
        pytest.param(
            lambda content, _: content.replace(b"checkpoint 4 ", b"checkpoint 0 "),
            "checkpoint-older",
            marks=pytest.mark.fault("checkpoint-older"),
        ),
    ],
)
def test_a_damaged_checkpoint_is_named_and_not_used(quiet, tmp_path, damage, name):
    path = make_campaign(tmp_path, 1, "execution_models:Stops")
    out, draw = tmp_path / "run", random.Random(4)
    interrupt(path, out, 8)
    file = out / "checkpoints" / "set0.iteration"
    content = file.read_bytes()
    head = content.index(b"\n")
    for _ in range(3):
        kept = content[:head] if damage is not cut and name != "checkpoint-older" else b""
        file.write_bytes(kept + damage(content[len(kept) :], draw))
        shutil.copytree(out, tmp_path / "copy")
        campaign = run_campaign(configuration(path, tmp_path / "copy"), resume=True)
        (notice,) = campaign.notices
        assert row(name).told(notice) or "not a checkpoint of en4dvar" in notice
        assert campaign.exit_code == 0
        shutil.rmtree(tmp_path / "copy")
