"""The readings after the window beside what the posterior expected of them, read from a result."""

from en4dvar.plumbing.units import convert
from en4dvar.report.chart import POINTS, Chart, Panel, Row
from en4dvar.report.text import number_like, percent, pretty_unit, shown, with_unit
from en4dvar.results.store import StoredResult

COLUMNS = ("time_unit", "time", "unit", "reading", "q05", "q50", "q95", "inside")
CAPTION = (
    "The readings after the window, which the estimate has not seen, and what it expected of them: median and 5 to "
    "95 % of the posterior members with the errors of a reading and what the model may miss."
)


def withheld_lines(result: StoredResult) -> list[tuple[object, ...]]:
    """A line a reading after the window, in display units, the name of the data set first; none where none follows."""
    if "/withheld" not in result.groups:
        return []
    held, name = result.groups["/withheld"], result.observable
    about = held[name].attrs["display_units"], held["withheld_time"].attrs["display_units"]
    columns = (shown(held[key]).tolist() for key in ("withheld_time", name, *(f"{name}_{q}" for q in QUANTILES)))
    return [
        (result.name, about[1], time, about[0], value, low, median, high, int(low <= value <= high))
        for time, value, low, median, high in zip(*columns, strict=True)
    ]


QUANTILES = ("low", "median", "high")


def withheld_words(result: StoredResult) -> str:
    """How many lie in their bands, in a sentence; "" where no reading follows the window."""
    stats = result.group("sample_stats").attrs
    if "withheld_readings" not in stats:
        return ""
    count, inside, rms = (float(stats[f"withheld_{key}"]) for key in ("readings", "inside", "rms"))
    about = result.group("observed_data")[result.observable].attrs
    rms = convert(rms, about["units"], about["display_units"])
    unit = pretty_unit(about["display_units"])
    off = f"{number_like(rms, rms)} {unit}".rstrip()
    return (
        f"{inside * count:.0f} of {count:.0f} readings after the window ({percent(inside)}) lie in the 90 % bands of "
        f"what was expected; they are off the medians by {off} (root mean square)."
    )


def expected(result: StoredResult) -> Chart:
    """Readings after the window over bands of what was expected."""
    held, name = result.groups["/withheld"], result.observable
    times = shown(held["withheld_time"])
    low, median, high = (shown(held[f"{name}_{q}"]) for q in QUANTILES)
    about = held[name].attrs
    panel = Panel(
        with_unit("time", held["withheld_time"].attrs["display_units"]),
        with_unit(about["symbol"], about["display_units"]),
        legend=True,
    )
    panel.band(times, low, high, "posterior", 0.3, "expected 90 %")
    panel.line(times, median, "posterior", 0.9, label="median")
    panel.dots(times, shown(held[name]), "ink", 2.2, label="reading")
    return Chart([Row(5.5 * POINTS, [panel])])
