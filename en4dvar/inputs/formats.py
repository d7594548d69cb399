"""The formats of data files and what may be done with their rows, in a module that is imported in no time."""

from collections.abc import Mapping
from typing import Literal

Format = Literal["csv", "mat", "xlsx"]
Disorder = Literal["refuse", "sort"]
Repeated = Literal["refuse", "average"]
Outliers = Literal["keep", "leave out"]
_TEXT: Mapping[str, Format] = {".csv": "csv", ".txt": "csv", ".dat": "csv", ".tsv": "csv"}
SUFFIXES: Mapping[str, Format] = {**_TEXT, ".mat": "mat", ".xlsx": "xlsx", ".xlsm": "xlsx"}
TRUTHS = ("dataset", "group", "nrmse_of_truth")  # of a simulated campaign: two first columns of the table, and the last
