"""The colours of pages and figures: Okabe & Ito's (safe for colour-blind readers), on light and on dark ground."""

from __future__ import annotations

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


def css_variables(palette: dict[str, str]) -> str:
    """Declarations of the palette for a CSS rule."""
    return " ".join(f"--{name}: {code};" for name, code in palette.items())
