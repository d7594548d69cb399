"""Numbers, units and symbols as the report writes them."""

from __future__ import annotations

import doctest

import pytest

from en4dvar.report import text


def test_examples_of_the_module():
    assert doctest.testmod(text).failed == 0


@pytest.mark.parametrize(
    ("mean", "std", "shown"),
    [
        (2.80123, 0.104, "2.80 ± 0.10"),
        (0.08, 0.00871, "0.0800 ± 0.0087"),
        (-0.031, 0.39, "−0.03 ± 0.39"),
        (101325.0, 250.0, "101325 ± 250"),
        (5.0, 0.0, "5.000 ± 0.000"),
        (float("nan"), float("nan"), "– ± –"),
        (3.2e9, 1e8, "3.2×10⁹ ± 1×10⁸"),
        (2e-9, 1e-10, "2×10⁻⁹ ± 1×10⁻¹⁰"),
    ],
)
def test_plus_minus(mean, std, shown):
    assert text.plus_minus(mean, std) == shown


def test_no_minus_stands_before_a_rounded_zero():
    assert (text.percent(-0.004), text.percent(-0.06), text.percent(float("nan"))) == ("0 %", "-6 %", "–")


@pytest.mark.parametrize(
    ("symbol", "html"),
    [
        (r"$p_{\infty}$", "<i>p</i><sub>∞</sub>"),
        (r"$R_\mathrm{eq}$", "<i>R</i><sub>eq</sub>"),
        (r"$R_\mathrm{<script>}$", "<i>R</i><sub>&lt;script&gt;</sub>"),
        (r"$\dot R^2$", "<i>dotR</i><sup>2</sup>"),
    ],
)
def test_symbols_as_html(symbol, html):
    assert str(text.symbol_html(symbol)) == html
