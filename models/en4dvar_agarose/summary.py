"""A sweep's result as CSV and as a few lines of text, in display units."""

from __future__ import annotations

from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert
from en4dvar.sampling.sweep import SweepResult


def sweep_csv(result: SweepResult) -> str:
    """One line a data set: best fit, time shift, NRMSE."""
    heads = [p.name if p.unit == "1" else f"{p.name} ({p.display_unit or p.unit})" for p in result.parameters]
    lines = [["dataset", *heads, "t_s (us)", "NRMSE"]]
    for i, name in enumerate(result.names):
        values = [
            convert(float(v), p.unit, p.display_unit or p.unit)
            for v, p in zip(result.theta[i], result.parameters, strict=True)
        ]
        lines.append([name, *(f"{v:.6g}" for v in values), f"{result.shift[i] * 1e6:.4g}", f"{result.nrmse[i]:.6f}"])
    return csv_text(lines)


def sweep_text(result: SweepResult) -> str:
    """NRMSE-weighted mean ± standard deviation of every parameter, and the range of NRMSE."""
    lines = [f"{len(result.names)} data set(s), {result.trajectories} trajectories"]
    for p, mean, std in zip(result.parameters, result.mean, result.std, strict=True):
        unit = p.display_unit or p.unit
        values = [convert(float(v), p.unit, unit) for v in (mean, std)]
        shown = "" if unit == "1" else f" {unit}"
        lines.append(
            f"  {p.label}: {p.name} = {values[0]:.4g}{f' ± {values[1]:.2g}' if len(result.names) > 1 else ''}{shown}"
        )
    fits = result.nrmse
    return "\n".join([*lines, f"  NRMSE {fits.min():.4f} to {fits.max():.4f}, mean {fits.mean():.4f}"])
