"""The order of a folder's frames, and what is missing among them, by the numbers in their names."""

import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from statistics import mean

from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.hints import listed

WHOLE = r"([0-9]{1,40})"
BROKEN = r"((?<![0-9.])[0-9]{1,40}\.[0-9]{1,40}(?!\.?[0-9])|[0-9]{1,40})"
UNEVEN = 0.45  # of a step between numbers, which may be rounded: 0, 2, 5, 8, 10
MOST = 100_000  # frames of a folder, with those that are missing
BEFORE_A_SIGN = " _=([,"  # after anything else, a minus joins words, as in img-001 or 2024-03-01


def in_order(path: Path, files: Sequence[Path]) -> tuple[list[Path], list[int], list[str]]:
    """The frames in a folder by the numbers in their names, how many are missing after each, and what to tell of it.

    A minus is a sign after a blank or an underscore, or where other names lack it. A point makes decimals, unless
    1.9 and 1.10 show that it stands before a count. Of the numbers in a name, that counts which goes up from frame to
    frame, by steps of one size, or whole multiples of it where frames are missing.

    Raises DataError: a picture is not named as most are, two have the same numbers, or the numbers go up unevenly.
    """
    parts = [re.split(BROKEN if _decimal(files) else WHOLE, file.stem) for file in files]
    texts = {(at, text) for name in parts for at, text in enumerate(name) if at % 2 == 0}
    keys = {file: _key(name, texts) for file, name in zip(files, parts, strict=True)}
    files = sorted(files, key=lambda file: keys[file])
    for a, b in pairwise(files):
        if keys[a] == keys[b]:
            raise DataError(f"{path}: {a.name} and {b.name} have the same numbers, so that their order is unknown")
    kinds = Counter(tuple(key[::2]) for key in keys.values())
    usual, many = kinds.most_common(1)[0]
    odd = [file.name for file in files if tuple(keys[file][::2]) != usual]
    if odd and 2 * many > len(files):
        raise DataError(f"{path}: not named as the other {many} frames are, and so no frame: {listed(odd, 3)}; move it")
    numbers = [] if odd else list(zip(*(keys[file][1::2] for file in files), strict=True))
    steps = [[b - a for a, b in pairwise(column)] for column in numbers]
    rising = [of_column for of_column in steps if min(of_column, default=0) > 0]
    none = [0] * len(files)
    if not rising:
        words = f"{path}: no number in the names counts the frames, which are read in the order of their names"
        return list(files), none, [words] * (len(files) > 1)
    for of_column in rising:
        step = mean(s for s in of_column if s < 2 * min(of_column))
        times = [max(round(s / step), 1) for s in of_column]
        if all(abs(s / step - n) <= UNEVEN for s, n in zip(of_column, times, strict=True)) and sum(times) < MOST:
            break
    else:
        least, most = min(rising[0]), max(rising[0])
        raise DataError(
            f"{path}: the numbers in the names of its frames go up by {least} to {most}, which tells no steady clock; "
            "name frames by their count (frame_0001, frame_0002, …), without the numbers of those that are missing"
        )
    missing, notes = [*(n - 1 for n in times), 0], []
    if step > 1 and step == int(step):
        notes.append(
            f"{path}: the numbers go up by {step}; the frame rate is taken as that of the frames that are there"
        )
    if lost := sum(missing):
        after = listed((file.name for file, n in zip(files, missing, strict=True) if n), 3)
        words = "1 frame is" if lost == 1 else f"{lost} frames are"
        notes.append(f"{path}: {words} missing by the numbers in the names, after {after}; times follow the numbers")
    return list(files), missing, notes


def _decimal(files: Sequence[Path]) -> bool:
    """True if a point in names is that of decimals: 0.5 before 0.75, but 1.9 before 1.10 counts within 1."""
    digits = [part.split(".")[1] for file in files for part in re.findall(BROKEN, file.stem) if "." in part]
    return len({len(part) for part in digits}) == 1 or not any(part.endswith("0") for part in digits)


def _key(parts: list[str], texts: set[tuple[int, str]]) -> list[str | Decimal]:
    """Texts and numbers of a name by turns, signs with their numbers; ``texts`` are those of all names, by place."""
    key: list[str | Decimal] = [*parts]
    for at in range(1, len(parts), 2):
        text, sign = parts[at - 1][:-1], parts[at - 1][-1:]
        apart = (text or at == 1) and text[-1:] in BEFORE_A_SIGN
        if sign == "+" or (sign == "-" and (apart or (at - 1, text) in texts)):
            key[at - 1 : at + 1] = [text, Decimal(sign + parts[at])]
        else:
            key[at] = Decimal(parts[at])
    return key
