"""Examples that come with the package, for those without a clone: each a folder with a configuration and its data."""

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import make_folder, write_text

EXAMPLES = ("quickstart",)


def write_example(name: str, folder: Path, force: bool = False) -> Path:
    """Write the files of an example below ``folder``; returns the path of its configuration, ``<name>.yaml``.

    Raises
    ------
    OutputError: a file is there already (unless ``force``) or cannot be written.
    """
    items = dict(_walk(files(__name__) / name, Path()))
    for path in items:
        if (folder / path).exists() and not force:
            raise OutputError(f"{folder / path}: exists; give --force to replace it")
    for path, source in items.items():
        make_folder((folder / path).parent)
        write_text(folder / path, source.read_text(encoding="utf-8"))
    return folder / f"{name}.yaml"


def _walk(folder: Traversable, path: Path) -> list[tuple[Path, Traversable]]:
    items: list[tuple[Path, Traversable]] = []
    for item in sorted(folder.iterdir(), key=lambda item: item.name):
        items += _walk(item, path / item.name) if item.is_dir() else [(path / item.name, item)]
    return items
