"""The result of a run of cycles, ``twin.nc`` or ``sequence.nc``: where it is, and reading it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from en4dvar.errors import OutputError
from en4dvar.storage.seal import check_seal

if TYPE_CHECKING:
    import xarray as xr

FILES = ("twin.nc", "sequence.nc")  # of runs of cycles


def cycles_file(run_dir: Path) -> Path | None:
    """The result of a twin experiment or a sequence in a run directory; None where there is none."""
    return next((run_dir / name for name in FILES if (run_dir / name).is_file()), None)


def read_cycles(path: Path) -> xr.Dataset:
    """A result file, in memory. Raises :class:`OutputError` where there is nothing to read."""
    import xarray as xr

    check_seal(path)
    try:
        with xr.open_dataset(path) as file:
            return file.load()
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: not a readable result: {error}") from None
