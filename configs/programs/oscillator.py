"""A mass on a spring as a program of its own: reads parameters and times from JSON, writes a table.

Stands for a solver in any language. Run as  python oscillator.py INPUT OUTPUT  it needs nothing but Python.
"""

import json
import math
import sys


def displacement(p, t):
    """x(t) of x'' + c x' + k x = 0 from rest at x = A, for c² < 4 k."""
    damping = p["c"] / 2
    omega = math.sqrt(p["k"] - damping**2)
    return p["A"] * math.exp(-damping * t) * (math.cos(omega * t) + damping / omega * math.sin(omega * t))


if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        given = json.load(file)
    if given["c"] ** 2 >= 4 * given["k"]:
        sys.exit("overdamped: this solver knows oscillations alone")
    with open(sys.argv[2], "w") as file:
        print("t,x", file=file)
        for t in given["times"]:
            print(f"{t!r},{displacement(given, t)!r}", file=file)
