"""Which tenth of the long tests a test is of."""

import hashlib


def is_of_tenth(name: str, tenth: int) -> bool:
    """Whether a test is of this tenth, on every machine and whatever else is collected."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") % 10 == tenth
