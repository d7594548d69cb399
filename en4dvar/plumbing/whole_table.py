"""Tables for Python. Imported where one is made: pandas takes long to import."""

import pandas as pd


class WholeTable(pd.DataFrame):  # type: ignore[misc]
    """A table whose text has every column, below each other where the terminal is narrow; pandas leaves some out."""

    @property
    def _constructor(self) -> "type[WholeTable]":
        return WholeTable

    def __repr__(self) -> str:
        with pd.option_context("display.max_columns", None, "display.width", None):
            return str(super().__repr__())
