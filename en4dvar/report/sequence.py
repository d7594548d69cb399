"""Page and figures of a sequence, from ``sequence.nc`` alone: state, parameters, innovations in time, and ranks."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from en4dvar.plumbing.units import convert
from en4dvar.report.chart import PAGE, POINTS, Chart, Panel, interval, stacked
from en4dvar.report.cycles import CERTAIN, RANKS, last_analysis, ranks, span_of, time_label, write_cycles_page
from en4dvar.report.svg import Captioned
from en4dvar.report.text import plain_number, pretty_unit, shown, with_unit
from en4dvar.results.netcdf import Group
from en4dvar.results.series_file import read_series

SHOWN = 5  # variables or observations in a figure
LISTED = 40  # in a table


def write_sequence_report(run_dir: Path, files: bool = False) -> Path:
    """Write ``report.html`` from ``sequence.nc``, with ``files`` also its figures as PDF and PNG; returns its path.

    Raises :class:`~en4dvar.plumbing.errors.OutputError` where there is nothing to read or the directory cannot
    be written.
    """
    data = read_series(run_dir / "sequence.nc")
    readings = int(np.isfinite(data["observations"].values).sum())
    words = (
        "Of a filter or smoother that is right, normalised innovations have a root mean square of 1, and 95 % of the "
        "innovations lie within two expected standard deviations."
    )
    columns = ["observed", "readings", "root mean square of normalised innovations", "within 2 std"]
    last = "The analysis at the last observation time, given all observations."
    estimates = [
        (name, plain_number(mean, 4), plain_number(std, 2), pretty_unit(unit))
        for name, mean, std, unit in islice(last_analysis(data), LISTED)
    ]
    rows = []
    for i, name in enumerate(data["observation"].values[:LISTED]):
        innovations = data["normalised_innovation"].values[:, i]
        innovations = innovations[np.isfinite(innovations)]
        size = plain_number(float(np.sqrt(np.mean(innovations**2))), 3) if len(innovations) else "–"
        share = f"{100 * np.mean(np.abs(innovations) <= 2):.0f} %" if len(innovations) else "–"
        rows.append((str(name), str(len(innovations)), size, share))
    return write_cycles_page(
        run_dir,
        data,
        kind="Sequential assimilation",
        what=f"the series {data.attrs['data_set']}, cycle by cycle.",
        cycle="an observation time",
        iterations=float(data["iterations"].values.mean()),
        facts=[
            ("Times", str(data.sizes["time"]), "at which there were observations"),
            ("Readings", str(readings), f"of {data.sizes['observation']} quantities"),
        ],
        tables=[
            ("State and parameters at the end", ["variable", "mean", "std", "unit"], estimates, last),
            ("Innovations", columns, rows, words),
        ],
        figures=sequence_figures(data),
        files=files,
    )


def sequence_figures(data: Group) -> Iterator[Captioned]:
    """Each figure with its caption."""
    best = "smoothed" if "smoothed_mean" in data else "analysis"
    parameters, state = str(data.attrs["parameters"]).split(", "), list(map(str, data["state"].values))
    held = np.array([state.index(name) for name in parameters if name in state], dtype=np.intp)
    spread = data[f"{best}_std"].values.max(axis=0)
    uncertain = np.flatnonzero(spread > CERTAIN * np.abs(data[f"{best}_mean"].values).max(axis=0))
    dynamic = np.array([i for i in uncertain if i not in held], dtype=np.intp)
    if len(dynamic):
        words = "" if len(dynamic) <= SHOWN else f" {SHOWN} of {len(dynamic)} variables."
        caption = f"The state in time: mean of the {best} ensemble within two standard deviations, and readings of it."
        yield "state", caption + words, in_time(data, best, _some(dynamic, SHOWN))
    if len(held):
        caption = "The parameters in time: mean of the analysis within two standard deviations, given the data so far."
        yield "parameters", caption, in_time(data, "analysis", held[:SHOWN])
    caption = "Innovations, the readings minus their forecasts, within two of their expected standard deviations."
    yield "innovations", caption, innovations(data)
    yield "ranks", RANKS, ranks(data["rank"].values, int(data.attrs["members"]))


def in_time(data: Group, kind: str, chosen: npt.NDArray[np.intp]) -> Chart:
    """Mean ± 2 std of some variables of the state, one panel each, and the readings that are of them."""
    time, read_as = shown(data["time"]), list(data["observation_state"].values)
    panels = []
    for i in chosen:
        name = str(data["state"].values[i])
        unit, display = str(data["units"].values[i]), str(data["display_units"].values[i])
        mean, std = (convert(data[f"{kind}_{what}"].values[:, i], unit, display) for what in ("mean", "std"))
        panel = Panel(ylabel=with_unit(name, display), xlim=span_of(time))
        panel.band(time, *interval(mean, std, 2, bool(data["positive"].values[i])), "posterior", 0.25, "± 2 std")
        panel.line(time, mean, "posterior", 0.9, label=kind)
        if name in read_as:
            readings = convert(data["observations"].values[:, read_as.index(name)], unit, display)
            panel.dots(time, readings, "ink", 1.6, label="readings")
        panels.append(panel)
    return stacked(panels, 2.8 * POINTS, time_label(data), PAGE)


def innovations(data: Group) -> Chart:
    """Innovations in time over ± 2 expected std, some of the observations."""
    time = shown(data["time"])
    innovation = data["observations"].values - data["predicted_mean"].values
    expected = np.hypot(data["predicted_std"].values, data["observation_std"].values)
    panels = []
    for i in _some(np.arange(data.sizes["observation"]), SHOWN):
        unit, display = (str(data[f"observation_{kind}"].values[i]) for kind in ("units", "display_units"))
        there = np.isfinite(innovation[:, i])
        at, width = time[there], 2 * convert(expected[there, i], unit, display)
        panel = Panel(ylabel=with_unit(str(data["observation"].values[i]), display), xlim=span_of(time))
        panel.band(at, -width, width, "prior", 0.3, "± 2 expected std")
        panel.rule(0, size=0.5)
        panel.dots(at, convert(innovation[there, i], unit, display), "ink", 1.6, label="innovation")
        panels.append(panel)
    return stacked(panels, 2.6 * POINTS, time_label(data), PAGE)


def _some(places: npt.NDArray[np.intp], most: int) -> npt.NDArray[np.intp]:
    """All of few, else some that are spread evenly."""
    return np.asarray(places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))])
