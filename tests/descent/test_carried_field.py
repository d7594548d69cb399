"""A field that is carried along: where a reading acts is where what it read was when the clock began."""

from __future__ import annotations

import numpy as np
import pytest
from field_models import PLACES, Line, write_line

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.estimation.assimilate import assimilate
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors.dependence import correlation_of_places

VELOCITY, STD, TIMES = 1.0, 0.3, np.arange(1.0, 7.0)  # two cells a second
CELLS = np.array([14, 20, 26])


class Carried(Line):
    """u(x, t) = u(x − v t, 0); what enters is the base."""

    def step(self, x, t0, t1):
        u = np.interp(PLACES - VELOCITY * (t1 - t0), PLACES, x[:30], left=self.base)
        return np.append(u, x[30])


def written(folder, localisation, members=60):
    rng = np.random.default_rng(5)
    truth = 2 + np.linalg.cholesky(gaussian() + 1e-9 * np.eye(30)) @ rng.standard_normal(30)
    rows = [(t, c, truth[c - int(2 * t)] + STD * rng.standard_normal()) for t in TIMES for c in CELLS]
    text = "t,cell,u\n" + "".join(f"{t:g},{c},{v}\n" for t, c, v in rows)
    changes = [("field_models:Line", "descent.test_carried_field:Carried"), ("{radius: 300 cm}", localisation)]
    path = write_line(folder, *changes, ("members: 12", f"members: {members}"), data=text)
    return build(load_config(path))[0], load_config(path).assimilation, rows


def gaussian():
    return correlation_of_places("gaussian", PLACES[:, None], 1.5)


def closed_form(rows):
    """Mean and std of the initial field by Kalman's gain."""
    H = np.zeros((len(rows), 30))
    H[range(len(rows)), [c - int(2 * t) for t, c, _ in rows]] = 1
    P = gaussian()
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + STD**2 * np.eye(len(rows)))
    return 2 + K @ (np.array([v for *_, v in rows]) - 2), np.sqrt(np.diag(P - K @ H @ P))


@pytest.mark.parametrize("velocity", ["1 m/s", "[100 cm/s]"])
def test_with_its_velocity_the_posterior_is_near_the_closed_form(tmp_path, velocity):
    off = {}
    for name, asked in (("carried", f"{{radius: 300 cm, velocity: {velocity}}}"), ("still", "{radius: 300 cm}")):
        problem, settings, rows = written(tmp_path, asked)
        mean, std = closed_form(rows)
        (field,) = assimilate(problem, settings, 1).fields
        off[name] = np.sqrt(np.mean(((field.centre - mean) / std) ** 2)), np.mean(np.abs(np.log(field.std / std)))
    assert off["carried"][0] < 0.25 * off["still"][0]
    assert off["carried"][1] < 0.25 * off["still"][1]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("{radius: 300 cm, velocity: [1 m/s, 2 m/s]}", "velocity: 2 numbers, u has 1 coordinates"),
        ("{radius: 300 cm, velocity: 2 m}", "velocity"),
        ("{by: correlation, velocity: 1 m/s}", "not with by: correlation"),
    ],
)
def test_a_velocity_that_cannot_be(tmp_path, asked, words):
    def tried():
        problem, settings, _ = written(tmp_path, asked)
        assimilate(problem, settings, 1)

    with pytest.raises(ConfigError, match=words):
        tried()
