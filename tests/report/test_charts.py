"""Charts: what a page shows lies where the numbers are, the same on paper, and costs no matplotlib."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from en4dvar.report.chart import PAGE, Chart, Panel, Row, in_columns, numbers, powers, stacked, ticks
from en4dvar.report.figures import steps
from en4dvar.report.page import SetSummary, render_overview
from en4dvar.report.paper import on_paper, save_chart
from en4dvar.report.result import Result
from en4dvar.report.svg import SHOWN, svg


def drawn(panel, height=100.0):
    """The drawing of one panel, the frame of its marks (x, y, width, height), and the paths of its marks."""
    text = str(svg(Chart([Row(height, [panel])], 200.0), "a", "about"))
    box = re.search(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"/>', text)
    marks = re.search(r"<g clip-path[^>]*>(.*?)</g>", text, re.S)[1]
    return text, [float(v) for v in box.groups()], re.findall(r'd="([^"]*)"', marks)


def points(path):
    return np.array([[float(v) for v in pair] for pair in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", path)])


@pytest.mark.parametrize("x_logarithmic", [False, True])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_marks_lie_where_the_axes_say(logarithmic, x_logarithmic):
    panel = Panel(xlim=(1.0, 100.0), ylim=(1.0, 100.0), logarithmic=logarithmic, x_logarithmic=x_logarithmic)
    panel.line([1, 10, 100], [1, 10, 100], "ink")
    _, (x, y, width, height), (path,) = drawn(panel)
    across, up = (np.array([0, 0.5 if log else 9 / 99, 1]) for log in (x_logarithmic, logarithmic))
    assert points(path) == pytest.approx(np.column_stack([x + width * across, y + height * (1 - up)]), abs=0.11)


def test_an_axis_may_run_downwards_and_have_names():
    panel = Panel(xlim=(0.0, 1.0), ylim=(2.0, 0.0), yticks=(0, 2), y_names=("first", "last"), title="one\ntwo")
    text, (_, y, _, height), _ = drawn(panel)
    heights = {word: float(at) for at, word in re.findall(r'y="([\d.]+)"[^>]*>(first|last|one|two)<', text)}
    assert heights["last"] - heights["first"] == pytest.approx(height, abs=0.2)
    assert heights["one"] < heights["two"] < y


def test_level_lines_and_tiles_lie_at_their_values():
    panel = Panel(xlim=(0.0, 10.0), ylim=(0.0, 4.0))
    panel.intervals([1, 2], [3, 6], [1, 2], "ink")
    panel.tiles([5.0], [2.0], (2.0, 1.0), "#ff0000")
    text, (x, y, width, height), (lines, tile) = drawn(panel)
    expected = [(0.1, 0.75), (0.3, 0.75), (0.2, 0.5), (0.6, 0.5)]
    assert points(lines) == pytest.approx(np.array([(x + width * u, y + height * v) for u, v in expected]), abs=0.11)
    assert points(tile)[0] == pytest.approx([x + 0.4 * width, y + height * 0.375], abs=0.2)
    assert 'fill="#ff0000"' in text


def test_stacked_panels_have_one_axis_and_one_legend():
    panels = [Panel(xlim=(0.0, 1.0)), Panel(xlim=(0.0, 1.0))]
    panels[0].line([0, 1], [0, 1], "ink", label="one")
    panels[1].dots([0, 1], [0, 1], "posterior", label="other")
    chart = stacked(panels, 80.0, "time")
    assert [panel.x_numbers for panel in panels] == [False, True]
    assert panels[0].entries() == ["one", "other"]
    assert len(on_paper(chart).axes[0].get_legend().get_texts()) == 2


def test_an_entry_of_a_legend_on_paper_shows_each_kind_of_its_marks_once():
    from matplotlib.lines import Line2D

    panel, x = Panel(legend=True), np.arange(3.0)
    for _ in range(2):
        panel.bars(x, x, x + 1, "ink", 0.6, label="data ± std")
        panel.dots(x, x, "ink", 2.2, label="data ± std")
    (ax,) = on_paper(Chart([Row(90.0, [panel])], 200.0)).axes
    legend = ax.get_legend()
    assert len(legend.get_texts()) == 1
    assert [line.get_marker() for line in legend.findobj(Line2D)] == ["None", "o"]


@pytest.mark.parametrize("legends", [1, 3])
def test_a_legend_leaves_its_panels_room(tmp_path, legends):
    """Matplotlib's layout warns, which is an error here, where a legend is wider than its panel."""
    panels = [Panel("G (kPa)", "density", title="(a)", legend=i < legends) for i in range(4)]
    for panel in panels:
        for k in range(4):
            panel.line([0, 1], [0, k], "posterior", label=f"QS QLKV, 0.{k} % gel")
    save_chart(Chart([Row(150.0, panels)], PAGE), tmp_path, "a")
    assert {file.name for file in tmp_path.iterdir()} == {"a.pdf", "a.png"}


def test_numbers_stand_at_their_ticks():
    panel = Panel(xlim=(0.0, 10.0), ylim=(-2.0, 2.0), yticks=(-2, 0, 2))
    text, (x, _, width, height), _ = drawn(panel)
    found = {v: (float(a), float(b)) for a, b, v in re.findall(r'<text x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]+)<', text)}
    assert found["−2"][1] - found["2"][1] == pytest.approx(height, abs=0.2)
    assert found["10"][0] - found["4"][0] == pytest.approx(0.6 * width, abs=0.2)
    assert found["4"][0] == pytest.approx(x + 0.4 * width, abs=0.2)


@pytest.mark.parametrize("names", [1, 2])
def test_a_number_at_the_end_of_an_axis_stays_within_the_drawing(names):
    panels = [Panel(xlim=(0.0, 0.15), xticks=(0.0, 0.05, 0.10, 0.15)) for _ in range(names)]
    text = str(svg(Chart([Row(100.0, panels)], 200.0), "a", "about"))
    end = max(float(x) for x in re.findall(r'x="([\d.]+)"[^>]*>0\.15<', text))
    assert end + 4 * 0.64 * 7 / 2 <= 200.1  # half of its four characters


def test_numbers_of_neighbours_keep_apart():
    """Below members in pairs "0.105" and "0.28" of two panels were written over each other."""
    first = Panel(xlim=(0.0984, 0.105), xticks=(0.1, 0.105), y_numbers=False)
    panels = [
        first,
        Panel(xlim=(0.279, 0.313), xticks=(0.28, 0.3), y_numbers=False),
        Panel(xlim=(-500, 500), left=False),
    ]
    text = str(svg(Chart([Row(100.0, panels)], 400.0), "a", "about"))
    numbers = re.findall(r'<text x="([\d.]+)" y="99.0"[^>]*>([^<]+)<', text)
    ends = [(float(x) - half, float(x) + half) for x, half in ((x, len(word) * 0.64 * 7 / 2) for x, word in numbers)]
    assert len(ends) > 5
    assert all(before[1] < after[0] for before, after in pairwise(ends))


def test_gaps_stay_gaps_and_what_is_not_finite_is_not_drawn():
    panel = Panel(xlim=(0.0, 4.0), ylim=(0.0, 4.0))
    panel.line([0, 1, 2, 3], [0, 1, np.nan, 3], "ink")
    panel.dots([1, 2], [np.nan, np.inf], "ink")
    panel.bars([1.0, 2.0], [np.nan, 0.0], [1.0, 2.0], "ink")
    _, _, paths = drawn(panel)
    assert [path.count("M") for path in paths] == [2, 1]
    assert not any(word in "".join(paths) for word in ("nan", "inf"))


def test_gaps_stay_gaps_in_a_line_of_many_points():
    """Intervals of 700 data sets were one line from each to the next."""
    panel, n = Panel(), 700
    panel.intervals(np.arange(n), np.arange(n) + 0.5, -np.arange(n), "ink")
    _, _, (path,) = drawn(panel)
    assert (path.count("M"), path.count("L")) == (n, n)


def test_values_that_agree_to_rounding_are_a_line():
    """Of a collapsed ensemble: no bins are that narrow."""
    panel = Panel()
    panel.histogram(np.array([1.0, 1.0 + 2.3e-16, 1.0]), "ink", alpha=1.0)
    assert [mark.kind for mark in panel.marks] == ["upright"]


@pytest.mark.parametrize("limits", [(101025, 101625), (1e7, 1.0001e7), (1.0001e-4, 1.0005e-4), (1.0, 1.0 + 1e-9)])
def test_ticks_that_differ_have_numbers_that_differ(limits):
    held = ticks(*limits, 5)
    assert len(set(numbers(held))) == len(held) > 2


def test_many_readings_stay_small_and_keep_their_extremes():
    x = np.arange(100_000.0)
    y = np.sin(x / 50)
    y[77_777] = 40.0
    panel = Panel()
    panel.line(x, y, "ink")
    panel.dots(x, y, "ink")
    text, (_, top, _, height), (line, dots) = drawn(panel)
    low, high = panel.limits()[1]
    assert len(points(line)) <= SHOWN
    peak = top + height * (1 - (40 - low) / (high - low))
    assert points(line)[:, 1].min() == pytest.approx(peak, abs=0.11)
    assert points(dots)[:, 1].min() == pytest.approx(peak, abs=0.11)
    assert len(text) < 1_000_000


@pytest.mark.parametrize(
    ("low", "high", "wanted", "expected"),
    [
        (0.0, 1.0, 5, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-0.24, 0.31, 4, [-0.2, 0, 0.2]),
        (3.1e-6, 9.2e-6, 4, [4e-6, 6e-6, 8e-6]),
        (7.0, 7.0, 4, [7.0]),
        (0.0, 9.0, (1, 2), [1, 2]),
    ],
)
def test_ticks_are_round(low, high, wanted, expected):
    assert ticks(low, high, wanted) == pytest.approx(expected)


def test_ticks_of_counts_are_whole_and_of_decades_are_powers():
    assert ticks(-0.1, 2.1, 5, whole=True) == [0, 1, 2]
    assert powers(0.5, 2e4) == pytest.approx([1, 10, 100, 1e3, 1e4])
    assert powers(2.0, 9.0) == pytest.approx([2, 5])
    assert numbers([-0.5, 0.0, 0.5]) == ["−0.5", "0", "0.5"]
    assert numbers([2e6, 4e6]) == ["2×10⁶", "4×10⁶"]


def test_words_are_escaped_and_symbols_set():
    panel = Panel(r"$R_0$ (µm)", '<b>"&', title=r"\$5")
    text, _, _ = drawn(panel)
    assert "&lt;b&gt;&#34;&amp;" in text
    assert ">$5<" in text
    assert re.search(r'font-style="italic">R</tspan><tspan dy="[\d.]+" font-size="[\d.]+">0</tspan><tspan dy="-', text)


def test_legend_names_the_marks_it_switches():
    panel = Panel(legend=True)
    panel.band([0, 1], [0, 0], [1, 1], "posterior", 0.3, "90 % & more")
    text, _, _ = drawn(panel)
    assert text.count('data-label="90 % &amp; more"') == 2


def test_capitals_of_a_legend_keep_away_from_the_next_mark():
    panel = Panel(legend=True)
    for label in ("RMSE", "spread"):
        panel.line([0, 1], [0, 1], "posterior", label=label)
    text, _, _ = drawn(panel)
    first, second = (float(x) for x in re.findall(r'<text x="([\d.]+)"[^>]*>(?=RMSE|spread)', text))
    wide = TextPath((0, 0), "RMSE", size=7, prop=FontProperties(family="DejaVu Sans")).get_extents().x1
    assert second - 14 - (first + wide) > 4


def test_paper_shows_the_same():
    panel = Panel("x", "y", xlim=(0.0, 3.0), ylim=(0.0, 9.0), title="T", title_colour="posterior")
    edges, values = np.array([0.0, 1.0, 3.0]), np.array([4.0, 8.0])
    panel.line(*steps(edges, values), "posterior", 2.0)
    bare = Panel(bare=True, words="+0.5")
    (ax, empty) = on_paper(Chart([Row(90.0, [panel, bare])], 200.0)).axes
    assert (ax.get_xlim(), ax.get_ylim(), ax.get_title()) == ((0.0, 3.0), (0.0, 9.0), "T")
    assert ax.lines[0].get_xydata().tolist() == [[0, 4], [1, 4], [1, 8], [3, 8]]
    assert ax.lines[0].get_linewidth() == 2.0
    assert [text.get_text() for text in empty.texts] == ["+0.5"]


def test_figures_of_one_name_are_each_cut_at_their_own_panel(analysis):
    """Of two groups the second figure was cut at the first one's frame: data sets of the larger group were not seen."""
    sets = [SetSummary.of(Result.from_analysis(analysis, {}), "a")]
    panels = [Panel(ylim=(-count, 1.0)) for count in (3.0, 8.0)]
    of_groups = [[("forest", "", Chart([Row(-20 * panel.ylim[0], [panel])]))] for panel in panels]
    headlines = [(f"{i}/population.html", "", [], figures, ()) for i, figures in enumerate(of_groups)]
    page = render_overview(sets, headlines, pages={}, failures={}, figures=[])
    cut = re.findall(r'<clipPath id="([^"]*)"><rect x="[^"]*" y="[^"]*" width="[^"]*" height="([^"]*)"', page)
    assert len({name for name, _ in cut}) == len({height for _, height in cut}) == 2


@pytest.mark.parametrize(("columns", "wide"), [(1, False), (2, True)])
def test_only_a_figure_of_several_columns_is_as_wide_as_a_page(columns, wide):
    """One panel on the page of a comparison had letters twice as high as the text."""
    assert ('class="wide"' in svg(in_columns([Panel(), Panel()], 100.0, columns), "a", "about")) == wide
