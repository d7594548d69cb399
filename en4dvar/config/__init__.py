"""YAML → validated, frozen settings; errors as ``file:line:col: path: message``, all at once."""

from en4dvar.config.load import Config, load_config, resolve, time_grid

__all__ = ["Config", "load_config", "resolve", "time_grid"]
