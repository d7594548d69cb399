"""Numbers, units and symbols as the report writes them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from en4dvar.plumbing.hints import percent
from en4dvar.report import text
from en4dvar.report.chart import GREYS, ramp
from en4dvar.report.export import is_math, latex_unit
from en4dvar.report.result import Result

NAN = float("nan")


@pytest.mark.parametrize(
    ("written", "arguments", "expected"),
    [
        (text.pretty_unit, ["um", "Pa s^0.6", "J/m^2", "1", "m s-1"], ["µm", "Pa·s^0.6", "J/m²", "", "m·s⁻¹"]),
        (text.rough_number, [287.4, 1.333, 6.18e6, NAN], ["290", "1.3", "6.2×10⁶", "–"]),
        (text.number_like, [(2.80123, 0.104), (-0.0, 0.1), (NAN, 1.0)], ["2.80", "0.00", "–"]),
        (text.number_like, [(6.041e-9, 1.239e-10), (1.239e-10, 1.239e-10)], ["6.04×10⁻⁹", "1.2×10⁻¹⁰"]),
        (text.signed, [0.234, -4.0], ["+0.23", "−4"]),
        (text.fixed, [(-1.25, 1), (-0.01, 1), (NAN, 2)], ["-1.2", "0.0", "–"]),
        (text.symbol_html, [r"$\mu$", r"$R_{\mathrm{eq}}$", "<b>"], ["<i>μ</i>", "<i>R</i><sub>eq</sub>", "&lt;b&gt;"]),
        (
            text.typeset,
            ["1.4 um in 2 uses, at 18.2 us.", "set time_std: 0.1 us"],
            ["1.4 µm in 2 uses, at 18.2 µs.", "set time_std: 0.1 µs"],
        ),
        (
            text.with_symbols,
            [r"$G$ · $\alpha$^0.23, $R_0$^−0.5 < R"],
            ["<i>G</i> · <i>α</i><sup>0.23</sup>, <i>R</i><sub>0</sub><sup>−0.5</sup> &lt; R"],
        ),
        (is_math, [r"$\mu_{max}$", r"$\frac{1}{2}R^2$", r"$\input{x}$", "$a}b{c$"], [True, True, False, False]),
        (latex_unit, ["um", "Pa s", "m s-1", "%", "1"], [r"$\mu$m", r"Pa\,s", r"m\,s$^{-1}$", r"\%", ""]),
        (text.since, [(2.0, "s", 30.0), (0.004, "s", 30.0)], ["time since 2 s of the data (s)", "time (s)"]),
        (ramp, [(GREYS, 0.0), (GREYS, 1.0)], ["#ffffff", "#000000"]),
    ],
)
def test_what_is_written(written, arguments, expected):
    assert [written(*(each if isinstance(each, tuple) else (each,))) for each in arguments] == expected


@pytest.mark.parametrize(
    ("mean", "std", "shown"),
    [
        (2.80123, 0.104, "2.80 ± 0.10"),
        (0.08, 0.00871, "0.0800 ± 0.0087"),
        (-0.031, 0.39, "−0.03 ± 0.39"),
        (101325.0, 250.0, "101325 ± 250"),
        (5.0, 0.0, "5.000 ± 0.000"),
        (float("nan"), float("nan"), "– ± –"),
        (3.2e9, 1e8, "(3.20 ± 0.10)×10⁹"),
        (2e-9, 1e-10, "(2.00 ± 0.10)×10⁻⁹"),
    ],
)
def test_plus_minus(mean, std, shown):
    assert text.plus_minus(mean, std) == shown


def test_no_minus_stands_before_a_rounded_zero():
    assert (percent(-0.004), percent(-0.06), percent(float("nan"))) == ("0 %", "−6 %", "–")


@pytest.mark.parametrize(
    ("symbol", "html"),
    [
        (r"$p_{\infty}$", "<i>p</i><sub>∞</sub>"),
        (r"$R_\mathrm{eq}$", "<i>R</i><sub>eq</sub>"),
        (r"$R_\mathrm{<script>}$", "<i>R</i><sub>&lt;script&gt;</sub>"),
        (r"$\dot R^2$", "<i>dot R</i><sup>2</sup>"),
        (r"$\ln u$", "<i>ln u</i>"),
        (r"$t/t_{\max} + 1$", "<i>t/t</i><sub>max</sub><i> + 1</i>"),
        (r"$G$ and $\mu$ for 5 $", "<i>G</i> and <i>μ</i> for 5 $"),
    ],
)
def test_symbols_as_html(symbol, html):
    assert str(text.symbol_html(symbol)) == html


def test_numbers_far_from_one_are_written_in_a_power_of_their_unit(analysis):
    """Six columns of 6.04×10⁻⁹ made the table of a coated bubble wider than a screen."""
    row = Result.from_analysis(analysis, {}).rows[0]
    assert text.in_powers(row) is row
    values = {name: 1e-9 * getattr(row, name) for name in text.VALUES}
    small = text.in_powers(replace(row, unit="kg/s", **values))
    power = text.power_of(values["mean"], values["std"])
    assert power in (-9, -6)
    assert small.mean * 10.0**power == pytest.approx(values["mean"])
    assert small.q95 * 10.0**power == pytest.approx(values["q95"])
    assert text.pretty_unit(small.unit) == f"10{'⁻⁹' if power == -9 else '⁻⁶'}·kg/s"
    assert small.dfs == row.dfs
