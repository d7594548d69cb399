"""Models without parameters of their own: what is estimated is a state, its changes, or numbers of the readings."""

import numpy as np
import pytest
from scipy.linalg import expm
from toys import SLOPE, Swing

import en4dvar
from en4dvar.assembly.build import build
from en4dvar.plumbing.errors import ConfigError

NOISE = 0.1
TIMES = np.linspace(0.5, 6.0, 12)


def position(t, since=0.0, start=(1.0, 0.0)):
    return (expm(SLOPE * (t - since)) @ start)[0] if t > since else 0.0


BASE = np.array([position(t) for t in TIMES])
OF_START = np.array([[position(t, 0, e) for e in np.eye(2)] for t in TIMES])
OF_KNOTS = np.array([[position(t, knot, (0, 1)) for knot in (2.0, 4.0)] for t in TIMES])
START = {"initial_state": {"x": {"std": "0.5 m"}, "v": {"std": "0.4 m/s"}}}
CHANGES = {"model_error": {"v": {"at": ["2 s", "4 s"], "std": "0.3 m/s"}}}


@pytest.mark.parametrize(
    ("sections", "names", "response", "std"),
    [
        (START, ["initial_x", "initial_v"], OF_START, [0.5, 0.4]),
        (CHANGES, ["v_change_1", "v_change_2"], OF_KNOTS, [0.3, 0.3]),
    ],
)
def test_the_initial_state_or_the_model_error_alone_is_something_to_estimate(sections, names, response, std):
    noise = NOISE * np.random.default_rng(1).standard_normal(len(TIMES))
    y = BASE + response @ [0.2, 0.3] + noise
    # of a linear Gaussian problem the posterior is Kalman's
    covariance = np.diag(np.square(std))
    gain = covariance @ response.T @ np.linalg.inv(response @ covariance @ response.T + NOISE**2 * np.eye(len(y)))
    mean, spread = gain @ (y - BASE), np.sqrt(np.diag(covariance - gain @ response @ covariance))
    told = en4dvar.estimate(Swing, (TIMES, y), {}, error=NOISE, progress=False, **sections).summary()
    assert list(told.index) == names
    assert told["mean"].to_numpy() == pytest.approx(mean, abs=1e-8)
    assert told["std"].to_numpy() == pytest.approx(spread, rel=1e-8)


@pytest.mark.parametrize("name", ["t_s", "sigma", "reading_scale"])
def test_numbers_of_the_readings_alone_are_estimated(name):
    y = BASE + NOISE * np.random.default_rng(2).standard_normal(len(TIMES))
    prior = {"prior": "normal", "mean": "0 s", "std": "0.3 s"}
    if name != "t_s":
        prior = {"prior": "lognormal", "median": 1, "log_std": 0.5}
    told = en4dvar.estimate(Swing, (TIMES, y), {name: prior}, error=NOISE, progress=False).summary()
    true = 0.0 if name == "t_s" else 1.0
    assert abs(told["mean"].iloc[0] - true) < 3 * told["std"].iloc[0]


def test_a_file_needs_no_section_of_parameters(tmp_path):
    np.savetxt(tmp_path / "b.csv", np.c_[TIMES, BASE], delimiter=",", header="t,x", comments="")
    (tmp_path / "oscillator.py").write_text("from toys import Swing as Swing\n", encoding="utf-8")
    text = (
        "name: alone\n"
        "model: {name: ./oscillator.py:Swing}\n"
        "data: {path: b.csv, columns: {time: {name: t, unit: s}, x: {name: x, unit: m}}, error: {x_std: 0.1 m}}\n"
    )
    file = tmp_path / "alone.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="no parameter has a prior, nor is there initial_state or model_error"):
        build(en4dvar.load_config(file))
    file.write_text(text + "initial_state: {x: {std: 0.5 m}}\n", encoding="utf-8")
    (problem,) = build(en4dvar.load_config(file))
    assert problem.prior.names == ("initial_x",)
