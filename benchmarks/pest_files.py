"""How many control files of PEST are read, and whether pyemu says the same of them; needs ``pip install pyemu``.

    python benchmarks/pest_files.py FOLDER     # of control files, e.g. the autotests of pyemu and benchmarks of PEST++

Templates and instruction files that are not there are stood in for by templates of all parameters and empty
instructions, as nothing is run. Prints how many files are read and why others are refused; and, of those that pyemu
reads too, the largest difference of its parameters (``parval1``, std of the prior from the bounds or ``parcov``,
behind the scale) and observations (values, std from the weights), relative.
"""

from __future__ import annotations

import math
import re
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import en4dvar
from en4dvar.model.programs.control import PARAMETERS, from_pest
from en4dvar.model.programs.control_file import read_control
from en4dvar.model.programs.languages import identifier

MISSING = re.compile(r"(\S*): no such file.*")


def read(path: Path) -> tuple[dict, int]:
    """What a control file says, and how many of its files had to be stood in for."""
    for count in range(10_000):
        try:
            return from_pest(path, prior_information=False), count
        except en4dvar.ConfigError as error:
            lost = MISSING.fullmatch(str(error))
            if not lost or Path(lost[1]).suffix in (".cov", ".jcb", ".jco", ".csv", ".dat"):
                raise
            Path(lost[1]).parent.mkdir(parents=True, exist_ok=True)
            rows = read_control(path).rows("parameter data", PARAMETERS)
            spaces = "".join(f"~{row.word('parnme')}~\n" for row in rows)
            Path(lost[1]).write_text("pif @\n" if lost[1].endswith(".ins") else f"ptf ~\n{spaces}")
    raise AssertionError(path)


def difference(path: Path, found: dict) -> float:
    """The largest relative one from pyemu's numbers. Raises whatever pyemu raises."""
    import pyemu

    pst = pyemu.Pst(str(path))
    control = read_control(path)
    names = {identifier(row.word("parnme")): row.word("parnme") for row in control.rows("parameter data", PARAMETERS)}
    parcov = control.options.get("parcov")
    range_ = float(pst.pestpp_options.get("par_sigma_range", 4.0))
    prior = pyemu.Cov.from_parameter_data(pst, sigma_range=range_) if not parcov else None
    prior = pyemu.Cov.from_ascii(str(path.parent / parcov)) if parcov else prior
    spread = dict(zip(prior.row_names, np.sqrt(np.diag(prior.as_2d)), strict=True))
    worst = [0.0]
    for name, own in found["priors"].items():
        row = pst.parameter_data.loc[names[name]]
        if isinstance(own, float) or "tied" in own:
            worst.append(0.0 if isinstance(own, dict) else abs(own - row.parval1))
            continue
        middle = own.get("median", own.get("mean"))
        std = own["log_std"] / math.log(10) if "log_std" in own else own["std"] * abs(row.scale)
        if "log_std" in own and row.offset:  # there pyemu takes the logarithm behind scale and offset, PEST before
            std = spread[names[name]]
        worst += [
            abs(middle - row.parval1) / max(abs(row.parval1), 1e-300),
            abs(std / spread[names[name]] - 1),
        ]
    observed = pst.observation_data.loc[pst.observation_data.weight > 0]
    error = found["error"]
    std = error["observations_std"] if isinstance(error, dict) else error
    assert [name.lower() for name in observed.index] == found["model"]["outputs"]["observations"]["observations"]
    worst.append(float(np.max(np.abs(std * observed.weight.to_numpy() - 1))))
    worst.append(float(np.max(np.abs(found["data"]["observations"] - observed.obsval.to_numpy()))))
    return max(worst)


def main(folder: Path) -> None:
    reasons: Counter[str] = Counter()
    agree, stood_in, differences, silent = 0, 0, [], []
    paths = sorted(folder.rglob("*.pst"))
    for path in paths:
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch, "folder")
            shutil.copytree(path.parent, copy)
            try:
                found, count = read(copy / path.name)
            except en4dvar.ConfigError as error:
                text = re.sub(r"\S*/folder/\S*?:(\d+:)? ", "", str(error))
                reasons[re.sub(r"^\S*: No such", "a table or matrix: No such", text)] += 1
                continue
            agree += 1
            stood_in += bool(count)
            try:
                differences.append(own := difference(copy / path.name, found))
                if own > 1e-6:
                    silent.append(f"{path.relative_to(folder)}: {own:.1e}")
            except ImportError:
                continue
            except Exception as error:
                silent.append(f"{path.relative_to(folder)}: pyemu: {type(error).__name__}: {str(error)[:90]}")
    print(f"{len(paths)} control files: {agree} read ({stood_in} with stand-ins), {len(paths) - agree} refused")
    for text, count in reasons.most_common():
        print(f"{count:4} {text[:180]}")
    if differences:
        print(f"pyemu reads {len(differences)} of them too; largest difference {max(differences):.1e}")
    print("\n".join(silent))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
