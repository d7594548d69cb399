"""Examples that come with the package, for those without a clone: each a folder with a configuration and its data."""

from pathlib import Path

from en4dvar.plumbing.called import advised
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import make_folder, write_text

EXAMPLES = ("quickstart",)


def write_example(name: str, folder: Path, force: bool = False) -> Path:
    """Write the files of an example below ``folder``; returns the path of its configuration, ``<name>.yaml``.

    Raises :class:`OutputError`: a file is there already (unless ``force``) or cannot be written.
    """
    example = Path(__file__).parent / name
    items = {folder / file.relative_to(example): file for file in sorted(example.rglob("*")) if file.is_file()}
    for path in items:
        if path.exists() and not force:
            raise OutputError(f"{path}: exists; give {advised('--force')} to replace it")
    for path, source in items.items():
        make_folder(path.parent)
        write_text(path, source.read_text(encoding="utf-8"))
    return folder / f"{name}.yaml"
