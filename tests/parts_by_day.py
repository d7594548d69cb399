"""Which part of the slow or long tests a test is of: ``.ci/run`` runs another part each day."""

import hashlib


def is_of_part(name: str, part: int, of: int) -> bool:
    """Whether a test is of the part 0 to ``of`` - 1, on every machine and whatever else is collected."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % of == part
