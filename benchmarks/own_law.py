"""A law from a user's file against the same law built in: time per forecast, and until the first result.

Run ``python benchmarks/own_law.py``. The quadratic law is given by its strain energy; 48 members, acoustic start, one
thread, interleaved runs. Readiness is a fresh interpreter up to its first forecast, with the compiled kernels on disk.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from en4dvar_bubble import get_law, simulate

LAW = '''
from en4dvar_bubble import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import ALPHA, MU, G

class ByEnergy(ConstitutiveLaw):
    """$W = G/2 [I + alpha I^2/2]$."""
    parameters = (G, ALPHA, MU)

    def strain_energy_rate(self, stretch, p):
        I = stretch**-4.0 + 2 * stretch**2 - 3
        return 2 * p.G * (1 + p.alpha * I) * (stretch - stretch**-5.0)
'''
FRESH = """
import time; start = time.perf_counter()
import numpy as np
from en4dvar_bubble import simulate
simulate("law.py:ByEnergy", dict(G=500, alpha=0.03, mu=0.1, R0=5e-7), np.linspace(0, 80e-6, 161))
print(time.perf_counter() - start)
"""
MEMBERS, ROUNDS = 48, 30


def main() -> None:
    folder = Path(tempfile.mkdtemp())
    (folder / "law.py").write_text(LAW)
    rng = np.random.default_rng(0)
    medians = {"G": 500.0, "alpha": 0.03, "mu": 0.1, "R0": 0.5e-6}
    values = {name: m * np.exp(0.3 * rng.standard_normal(MEMBERS)) for name, m in medians.items()}
    times = np.linspace(0, 80e-6, 161)
    laws = {"own": get_law("law.py:ByEnergy", folder), "built in": get_law("quadratic-kelvin-voigt")}
    seconds: dict[str, list[float]] = {name: [] for name in laws}
    for _ in range(ROUNDS + 1):
        for name, law in laws.items():
            start = time.perf_counter()
            simulate(law, values, times)
            seconds[name].append(time.perf_counter() - start)
    median = {name: float(np.median(s[1:])) for name, s in seconds.items()}
    for name, value in median.items():
        print(f"{name:9} {1e6 * value / MEMBERS:8.1f} µs per trajectory")
    print(f"ratio     {median['own'] / median['built in']:8.2f}")
    ready = [
        float(subprocess.run([sys.executable, "-c", FRESH], cwd=folder, check=True, capture_output=True, text=True,
                             env=os.environ).stdout)
        for _ in range(3)
    ]  # fmt: skip
    print(f"ready     {min(ready):8.2f} s after the start of a fresh interpreter")


if __name__ == "__main__":
    main()
