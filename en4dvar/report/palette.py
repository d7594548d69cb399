"""The colours of pages and figures: Okabe & Ito's (safe for colour-blind readers), on light and on dark ground."""

from collections.abc import Sequence

_BOTH = {  # on light, on dark ground
    "paper": ("#ffffff", "#16161a"),
    "ink": ("#1b1b1f", "#ececf0"),
    "muted": ("#63636c", "#a9a9b4"),
    "grid": ("#dcdce2", "#3b3b44"),
    "prior": ("#85858f", "#9c9ca8"),
    "posterior": ("#0072b2", "#56b4e9"),
    "centre": ("#d55e00", "#ff9f5a"),
    "background": ("#009e73", "#2fd0a2"),
}
LIGHT, DARK = ({name: colours[k] for name, colours in _BOTH.items()} for k in (0, 1))
VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
GREYS = ("#ffffff", "#bdbdbd", "#636363", "#000000")


def ramp(anchors: Sequence[str], share: float) -> str:
    """The colour at a ``share`` of the way along ``anchors``.

    >>> ramp(GREYS, 0.0), ramp(GREYS, 1.0)
    ('#ffffff', '#000000')
    """
    place = min(max(share, 0.0), 1.0) * (len(anchors) - 1)
    first = min(int(place), len(anchors) - 2)
    low, high = (bytes.fromhex(code[1:]) for code in anchors[first : first + 2])
    mixed = bytes(round(a + (b - a) * (place - first)) for a, b in zip(low, high, strict=True))
    return f"#{mixed.hex()}"
