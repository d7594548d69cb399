"""Which of the slow tests ``.ci/run`` runs on a day: every one in eight days, and every long one in twenty."""

import hashlib


def is_of_day(name: str, day: int, of: int) -> bool:
    """Whether a test is of the part ``day % of`` of so many, on every machine and whatever else is collected."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % of == day % of
