"""What reads from outside, as functions of raw bytes: each must take anything without a traceback and without hanging.

A target returns whether the input was accepted. Whatever escapes it is a finding: an exception that is not an
:class:`~en4dvar.plumbing.errors.En4dvarError`, an error that does not say where, or a Python detail in its words.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from en4dvar.assembly.build import build
from en4dvar.config import Config
from en4dvar.config.document import read_document
from en4dvar.config.kinds import resolve_campaign
from en4dvar.descent.weight_space import WeightSpace
from en4dvar.executor import SerialExecutor
from en4dvar.inputs.members import read_covariance
from en4dvar.inputs.parts import Column, Matrix, TimeStep, read_contents
from en4dvar.inputs.readers import read_series
from en4dvar.plumbing.errors import ConfigError, DataError, En4dvarError
from en4dvar.plumbing.units import UnitError, parse_quantity
from en4dvar.report.result import load_result
from en4dvar.runs.checks import validate

TIME, RADIUS = Column("t_us", "us", "s"), Column("R_um", "um", "m")
LEAK = re.compile(r"Traceback|object at 0x|<class |NoneType|KeyError|AttributeError|not subscriptable")
LONGEST = 2_500  # characters of a line: every fault is told, but a wall of text helps nobody
MOST = 500  # members of an ensemble that is drawn


def configuration(content: bytes, folder: Path) -> bool:
    """A YAML file, the data it names, the inverse problems it means and the ensembles these begin with."""
    path = folder / "case.yaml"
    path.write_bytes(content)
    return _accepted(lambda: _ready(path), ConfigError, path)


def _ready(path: Path) -> None:
    config = validate(path)
    if not isinstance(config, Config) or config.assimilation.members > MOST:
        return
    for problem in build(config)[:1]:
        if problem.fields:  # the ensemble of which is another one
            return
        WeightSpace(problem, config.assimilation, config.seed, SerialExecutor())


def campaign(content: bytes, folder: Path) -> bool:
    """The YAML of a synthetic campaign."""
    path = folder / "case.yaml"
    path.write_bytes(content)
    return _accepted(lambda: resolve_campaign(read_document(path), folder), ConfigError, path)


def csv_series(content: bytes, folder: Path) -> bool:
    path = folder / "case.csv"
    path.write_bytes(content)
    _accepted(lambda: read_contents(path), DataError, path)
    return _accepted(lambda: read_series(path, TIME, RADIUS), DataError, path)


def csv_covariance(content: bytes, folder: Path) -> bool:
    path = folder / "case.csv"
    path.write_bytes(content)
    return _accepted(lambda: read_covariance(Matrix(path, "um^2", "m^2")), DataError, path)


def mat_series(content: bytes, folder: Path) -> bool:
    path = folder / "case.mat"
    path.write_bytes(content)
    _accepted(lambda: read_contents(path), DataError, path)
    return _accepted(
        lambda: read_series(path, TimeStep(Column("dt", "s", "s")), Column("R", "m", "m")), DataError, path
    )


def workbook(content: bytes, folder: Path) -> bool:
    path = folder / "case.xlsx"
    path.write_bytes(content)
    _accepted(lambda: read_contents(path), DataError, path)
    return _accepted(lambda: read_series(path, TIME, RADIUS), DataError, path)


def hdf_series(content: bytes, folder: Path) -> bool:
    """A MATLAB v7.3 file."""
    return mat_series(content, folder)


def quantity(content: bytes, folder: Path) -> bool:
    text = content.decode("utf-8", "replace")
    try:
        parse_quantity(text, "Pa s")
    except UnitError as error:
        _check(str(error), repr(text.strip()[:5])[1:-1], content)
        return False
    return True


def result_file(content: bytes, folder: Path) -> bool:
    """A result whose bytes were changed; the seal must tell before the HDF5 library reads a byte."""
    path = folder / "case.nc"
    path.write_bytes(content)
    return _accepted(lambda: load_result(path), En4dvarError, path)


TARGETS: Mapping[str, Callable[[bytes, Path], bool]] = {
    "configuration": configuration,
    "campaign": campaign,
    "csv": csv_series,
    "covariance": csv_covariance,
    "mat": mat_series,
    "mat 7.3": hdf_series,
    "workbook": workbook,
    "quantity": quantity,
    "result": result_file,
}


def _accepted(read: Callable[[], object], kind: type[En4dvarError], path: Path) -> bool:
    try:
        read()
    except kind as error:
        _check(str(error), path.stem, path.read_bytes())
        return False
    return True


def _check(message: str, where: str, content: bytes) -> None:
    """Raises AssertionError; what the ``content`` itself holds may be quoted."""
    assert message.strip(), "an empty message"
    assert where in message, f"does not say where: {message!r}"
    leaks = [leak for leak in LEAK.findall(message) if leak.encode() not in content]
    assert not leaks, f"a Python detail: {message!r}"
    longest = max(map(len, message.splitlines()))
    assert longest < LONGEST, f"{longest} characters"
