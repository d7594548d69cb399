"""Which of the slow tests ``.ci/run`` runs: another sixteenth every three hours, and of the long ones a thirtieth.

On each day there are several changes, and parts by the day were the same for all of them.
"""

import hashlib


def is_of_part(name: str, turn: int, of: int) -> bool:
    """Whether a test is of the part ``turn % of`` of so many, on every machine and whatever else is collected."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % of == turn % of
