"""Files that a siege begins with, and what it calls that is no command."""

from __future__ import annotations

import sys
from pathlib import Path

import av
import numpy as np
import tifffile
from test_control_files import CONTROL, PROGRAM

import en4dvar
from en4dvar.model.programs.control import from_pest
from en4dvar.plumbing.errors import En4dvarError
from en4dvar_movie.scene import Scene, render

STUDY = """\
name: s
seed: 1
synthetic: false
sweep: {trajectories: 500, step: 0.2 us, rounds: 1}
population: {rounds: 30, passes: 1, draws: 200, exact: 50}
gels:
  a: {nh: nh.yaml, qlkv: qlkv.yaml}
"""


def pest_case(folder: Path) -> None:
    """A control file with its template, instructions and program."""
    folder.mkdir()
    (folder / "line.pst").write_text(CONTROL.replace(sys.executable, "python3"))
    (folder / "line.tpl").write_text("ptf ~\n~        a           ~\n~      b             ~\n~ c  ~\n")
    (folder / "line.ins").write_text("pif @\nl1 !h1!\nl1 !h2!\nl1 !h3!\nl1 !bad!\n")
    (folder / "line.py").write_text(PROGRAM)


def estimate_pest(control: str, out: str) -> None:
    """Estimate what a control file says, with few members; what it names is not run where it was changed."""
    asked = from_pest(control, ["line.py"])
    if asked["model"]["command"] != "python3 -S line.py":
        return
    asked["model"]["time_limit"] = "5 s"
    en4dvar.estimate(**asked, progress=False, assimilation={"members": 5, "max_iterations": 2}, directory=out)


def pest(control: str, out: str) -> None:
    """The same as a command, with its exit code."""
    try:
        estimate_pest(control, out)
    except En4dvarError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)


def small_study(folder: Path, configs: Path) -> None:
    """One gel, two laws, three bubbles."""
    folder.mkdir()
    data = configs / "data" / "agarose_twin" / "agarose_03_0[1-3].csv"
    for law in ("nh", "qlkv"):
        text = (configs / f"agarose_03_{law}.yaml").read_text().replace("data/agarose_twin/agarose_03_*.csv", str(data))
        (folder / f"{law}.yaml").write_text(text.replace("members: 48", "members: 16"))
    (folder / "study.yaml").write_text(STUDY)


def movies(folder: Path) -> None:
    """A collapse of eight frames as TIFF, compressed TIFF, mp4 and AVI."""
    folder.mkdir()
    radii = np.maximum(5, 3 + 38 * np.abs(np.cos(np.pi * np.linspace(0, 1.2, 6) / 2)))
    frames = np.array(list(render(radii[:, None], Scene(), np.random.default_rng(3))))
    tifffile.imwrite(folder / "a.tif", frames, photometric="minisblack")
    tifffile.imwrite(folder / "b.tif", frames, photometric="minisblack", compression="zlib")
    for name, codec in (("c.mp4", "mpeg4"), ("d.avi", "mjpeg")):
        with av.open(str(folder / name), "w") as file:
            stream = file.add_stream(codec, rate=30)
            stream.height, stream.width = frames.shape[1:]
            stream.pix_fmt = "yuv420p" if codec == "mpeg4" else "yuvj420p"
            for frame in frames:
                shown = (frame >> 8 if frame.dtype == np.uint16 else frame).astype(np.uint8)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(np.repeat(shown[..., None], 3, -1), format="rgb24")))
            file.mux(stream.encode())
