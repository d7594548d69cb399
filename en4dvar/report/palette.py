"""The colours of pages and figures: Okabe & Ito's (safe for colour-blind readers), on light and on dark ground."""

from collections.abc import Sequence

LIGHT = {
    "paper": "#ffffff",
    "ink": "#1b1b1f",
    "muted": "#63636c",
    "grid": "#dcdce2",
    "prior": "#85858f",
    "posterior": "#0072b2",
    "centre": "#d55e00",
    "background": "#009e73",
}
DARK = {
    "paper": "#16161a",
    "ink": "#ececf0",
    "muted": "#a9a9b4",
    "grid": "#3b3b44",
    "prior": "#9c9ca8",
    "posterior": "#56b4e9",
    "centre": "#ff9f5a",
    "background": "#2fd0a2",
}


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


def ink(colour: str) -> str:
    """A colour of the palette as a CSS variable, any other as it is."""
    return colour if colour.startswith("#") else f"var(--{colour})"


def css_variables(palette: dict[str, str]) -> str:
    """Declarations of the palette for a CSS rule."""
    return " ".join(f"--{name}: {code};" for name, code in palette.items())
