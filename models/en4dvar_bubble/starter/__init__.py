"""From data to a first configuration (``en4dvar init``): what the data show, first guesses, a commented YAML file."""

from en4dvar_bubble.starter.config import Proposed, propose_config

__all__ = ["Proposed", "propose_config"]
