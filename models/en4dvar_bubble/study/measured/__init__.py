"""Calibration measured by repeated experiments, as the benchmarks wrote it: too slow to be part of every study.

``population.csv``: python benchmarks/study_population.py; ``reliability.csv``: python benchmarks/study_reliability.py.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
POPULATION_HEAD = ["gel", "seed", "parameter", "low", "median", "high", "true_mean", "mean_of_truths", "stacked_mean"]
POPULATION_HEAD += ["r_hat", "effective", "weighed_emulators", "weighed_runs"]
RELIABILITY_HEAD = ["experiment", "number", "generated_by", "delta_log_evidence"]
