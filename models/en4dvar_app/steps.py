"""Fields of the page → the words of one command, whose files all lie in the folder."""

import io
import re
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from en4dvar.plumbing.errors import En4dvarError, OutputError
from en4dvar.plumbing.files import read_plain, write_bytes, write_text
from en4dvar_app.trusted import below
from en4dvar_movie.frames import open_picture
from en4dvar_movie.table import movie_of, other_movie

OF_TRACK = ("pixel", "frame-rate", "exposure", "flashes", "raw", "bubble", "region")
OF_INIT = (
    "start", "law", "medium", "time-unit", "radius-unit", "time-column", "radius-column", "time-step", "frame-rate",
    "pixel", "by", "sheet",
)  # fmt: skip
TABLE, CORRECTIONS = ".csv", ".corrections.txt"
LONGEST = 1_000_000  # bytes of a text
_LINE_END = re.compile("\r\n?")  # a page knows only one
OUTLINE = re.compile(r"(?:-?\d{1,5}(?:\.\d{1,9})?,-?\d{1,5}(?:\.\d{1,9})? ){3,}")  # of three corners at least
Fields = Mapping[str, str]


def beside(movie: str, suffix: str) -> str:
    """The name of what belongs to a movie: its table, the corrections, the picture that says what is looked at."""
    return f"{movie.rpartition('.')[0] or movie}{suffix}"


def existing(root: Path, fields: Fields, key: str) -> str:
    """The name of a file or folder of ``root``, which holds no link that leads out of it. Raises En4dvarError: it is
    not there, or it is a movie for which the table of another one is in the way.
    """
    name = fields.get(key, "")
    if not name:
        raise En4dvarError(f"choose a {'configuration' if key == 'config' else key} first")
    path = below(root, name)
    if not path.exists():
        raise En4dvarError(f"{name}: is not in the folder any more")
    for part in path.iterdir() if path.is_dir() else ():
        below(root, part.relative_to(root).as_posix())
    if key == "movie" and (other := other_movie(below(root, table := beside(name, TABLE)), path)):
        raise En4dvarError(f"{table}: was read from {other}, to which its corrections belong; give {name} another name")
    return name


def _options(fields: Fields, names: tuple[str, ...]) -> list[str]:
    return [f"--{name}={fields[name].strip()}" for name in names if fields.get(name, "").strip()]


def _track(root: Path, fields: Fields) -> list[str]:
    movie = existing(root, fields, "movie")
    table, corrections = beside(movie, TABLE), beside(movie, CORRECTIONS)
    words = ["track", movie, *_options(fields, OF_TRACK)]
    if fields.get("mask"):
        words.append(f"--mask={existing(root, fields, 'mask')}")
    if below(root, corrections).is_file() and (root / corrections).read_text(encoding="utf-8").strip():
        words.append(f"--corrections={corrections}")
    below(root, f"{Path(table).stem}.html")
    if below(root, table).exists():
        if not movie_of(root / table):
            raise En4dvarError(f"{table}: is there and was not read from a movie; rename it first")
        words.append("--force")  # the same table, read anew
    return [*words, f"--out={table}"]


def _init(root: Path, fields: Fields) -> list[str]:
    data, name = existing(root, fields, "table"), fields.get("proposal", "").strip()
    if not name or Path(name).name != name or name.startswith("."):
        raise En4dvarError("give the new proposal a name without '/', such as gel.yaml")
    out = _unused(root, f"{name.removesuffix('.yaml')}.yaml", "give the new proposal another name")
    return ["init", f"--data={data}", *_options(fields, OF_INIT), f"--out={out}"]


def _unused(root: Path, name: str, otherwise: str) -> str:
    """The name of a file that is not there: no command of the page replaces what somebody may have edited."""
    if below(root, name).exists():
        raise En4dvarError(f"{name}: exists and is not replaced; {otherwise}")
    return name


def _config(root: Path, fields: Fields) -> str:
    name = existing(root, fields, "config")
    if not name.endswith((".yaml", ".yml")):
        raise En4dvarError(f"{name}: is not a configuration by its suffix (.yaml)")
    return name


def _run_dir(root: Path, fields: Fields) -> str:
    name = fields.get("run", "").strip()
    if not name or name in (".", "..") or "/" in name or "\\" in name or name.startswith("-"):
        raise En4dvarError("give the run a name without '/'" if name else "give the run a name")
    below(root, f"runs/{name}")
    return f"runs/{name}"


def _run(root: Path, fields: Fields) -> list[str]:
    out = _unused(root, _run_dir(root, fields), "give the new run another name, or continue that run")
    return ["run", _config(root, fields), f"--out={out}"]


def _compare(root: Path, fields: Fields) -> list[str]:
    runs = [_run_dir(root, {"run": name}) for name in fields.get("runs", "").split("\n") if name]
    if len(runs) < 2:
        raise En4dvarError("choose two runs or more")
    new = next(name for n in count(1) if not below(root, name := f"comparisons/{n}").exists())
    return ["compare", *runs, "--stored", f"--out={new}"]


def _export(root: Path, fields: Fields) -> list[str]:
    run = _run_dir(root, fields)
    out = _unused(root, f"{Path(run).name}_results.csv", "rename it first")
    return ["export", run, f"--out={out}"]


# The folder and fields → the words after ``en4dvar``. Raise En4dvarError, of a path OutputError.
STEPS: dict[str, Callable[[Path, Fields], list[str]]] = {
    "track": _track,
    "init": _init,
    "validate": lambda root, fields: ["validate", _config(root, fields)],
    "prior": lambda root, fields: ["validate", _config(root, fields), "--plot"],
    "run": _run,
    "resume": lambda root, fields: ["run", _config(root, fields), f"--out={_run_dir(root, fields)}", "--resume"],
    "compare": _compare,
    "export": _export,
}


def text_of(root: Path, fields: Fields) -> str:
    """The text of a configuration, or of the corrections of a movie ("" where there are none yet)."""
    path = _text_file(root, fields)
    return _LINE_END.sub("\n", read_plain(path, LONGEST).decode("utf-8", "replace")) if path.exists() else ""


def kept(root: Path, fields: Fields) -> None:
    """Write a text of the page: a configuration that is there, or the corrections of a movie. Raises En4dvarError:
    another window or program has changed the file since the page read it.
    """
    path = _text_file(root, fields)
    held, text = text_of(root, fields), fields.get("text", "")
    if held not in (fields.get("before", ""), text):
        raise En4dvarError(f"{path.name}: another window or program has changed it; load the page again to see it")
    if held != text:
        write_text(path, text)


def masked(root: Path, fields: Fields, shape: tuple[int, ...]) -> None:
    """Blacken or (``uncovers``) whiten the polygon ``outline``, "x,y x,y ...", in the mask of a movie of (H, W) pixels.
    Raises En4dvarError: the outline is none, or the mask is no picture of that size.
    """
    path, outline = below(root, beside(existing(root, fields, "movie"), ".mask.png")), fields.get("outline", "")
    if not OUTLINE.fullmatch(f"{outline} "):
        raise En4dvarError("draw around what shall not be looked at")
    picture = open_picture(path) if path.exists() else np.full(shape, 255, dtype=np.uint8)
    if picture.shape[:2] != shape:
        raise En4dvarError(f"{path.name}: is no picture of the size of the frames; rename it first")
    image = Image.fromarray(picture).convert("L")
    corners = [float(number) for number in re.split("[ ,]", outline)]
    ImageDraw.Draw(image).polygon(corners, fill=255 if fields.get("uncovers") else 0)
    out = io.BytesIO()
    image.save(out, "png")
    write_bytes(path, out.getvalue())


def _text_file(root: Path, fields: Fields) -> Path:
    name = _config(root, fields) if "config" in fields else beside(existing(root, fields, "movie"), CORRECTIONS)
    if below(root, name) != root / name:
        raise OutputError(f"{name}: is a link, which the page does not follow")
    return root / name
