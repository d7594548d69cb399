"""Oscillators that disturb the process they run in, told how by environment variables so that workers hear it too."""

from __future__ import annotations

import hashlib
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
from toy_models import Oscillator

from en4dvar.model.forward import Batch
from en4dvar.model.state import Array


def is_large(x: Array) -> bool:
    """Whether the members are of a data set of large amplitude."""
    return bool(np.median(x[:, 0]) > 150e-6)


class Slow(Oscillator):
    """Takes ``EN4DVAR_TEST_PAUSE`` seconds more for each batch of members."""

    def trajectories(self, x, times):
        time.sleep(float(os.environ.get("EN4DVAR_TEST_PAUSE", "0.02")))
        return super().trajectories(x, times)


class DiesOnce(Slow):
    """Kills its process at a data set of large amplitude, once: the file ``EN4DVAR_TEST_FLAG`` remembers."""

    def trajectories(self, x, times):
        flag = Path(os.environ["EN4DVAR_TEST_FLAG"])
        if is_large(x) and not flag.exists():
            flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().trajectories(x, times)


class DiesAlways(Oscillator):
    """Kills its process at a data set of large amplitude."""

    def trajectories(self, x, times):
        if is_large(x):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().trajectories(x, times)


class Hungry(Slow):
    """Takes 2 GB at a data set of large amplitude: always, or once where ``EN4DVAR_TEST_FLAG`` names a file."""

    def trajectories(self, x, times):
        flag = Path(os.environ.get("EN4DVAR_TEST_FLAG", ""))
        if is_large(x) and not flag.is_file():
            if flag.name:
                flag.touch()
            held = np.ones(250_000_000)
            time.sleep(60)
            del held
        return super().trajectories(x, times)


class Breaks(Oscillator):
    """Loses every member at a data set of large amplitude."""

    def step(self, x, t0, t1):
        if t0 == 0.0 and x[0] > 150e-6:
            raise ArithmeticError("too large")
        return super().step(x, t0, t1)


class Deaf(Oscillator):
    """At a data set of large amplitude, hours within one call of compiled code; the file ``EN4DVAR_TEST_FLAG`` tells,
    and keeps it from it where it is there.
    """

    def trajectories(self, x, times):
        flag = Path(os.environ["EN4DVAR_TEST_FLAG"])
        if is_large(x) and not flag.exists():
            flag.write_text("now")
            hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
        return super().trajectories(x, times)


class Stops(Oscillator):
    """Ctrl-C at call number ``stop_at`` of this process."""

    calls = 0
    stop_at = 0

    def trajectories(self, x, times):
        type(self).calls += 1
        if type(self).calls == type(self).stop_at:
            raise KeyboardInterrupt
        return super().trajectories(x, times)


class EndsAt(Oscillator):
    """Ends the process of the run at call number ``EN4DVAR_TEST_CALL`` of ``trajectories``; exit code 0."""

    calls = 0

    def trajectories(self, x, times):
        type(self).calls += 1
        if type(self).calls == int(os.environ["EN4DVAR_TEST_CALL"]):
            os._exit(0)
        return super().trajectories(x, times)


class Noisy(Oscillator):
    """0.1 % of noise in every step."""

    def step(self, x, t0, t1):
        return super().step(x, t0, t1) * (1 + 1e-3 * np.random.default_rng().standard_normal())


class Swift(Oscillator):
    """All members at once, in closed form."""

    def trajectories(self, x, times):
        time.sleep(float(os.environ.get("EN4DVAR_TEST_PAUSE", "0")))
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        x0, v0, k, c = (column[:, None] for column in x.T)
        a = c / (2 * self.mass)
        w = np.sqrt(k / self.mass - a**2)
        cosine, sine, decay = np.cos(w * own), np.sin(w * own) / w, np.exp(-a * own)
        position = decay * (x0 * cosine + (v0 + a * x0) * sine)
        velocity = decay * (v0 * cosine - (a * v0 + (a**2 + w**2) * x0) * sine)
        states = np.stack(np.broadcast_arrays(position, velocity, k, c), axis=-1)
        return Batch(np.array(own), states, self.layout)


class Waits(Oscillator):
    """Call number ``at`` of its thread, in the first iterations of a data set, waits for the file of a variable."""

    calls = threading.local()
    at = 9

    def trajectories(self, x, times):
        self.calls.n = getattr(self.calls, "n", 0) + 1
        if self.calls.n == self.at:
            self.wait(Path(os.environ["EN4DVAR_TEST_FLAG"]))
        return super().trajectories(x, times)

    def wait(self, flag):
        end = time.monotonic() + 300
        while not flag.exists():
            if time.monotonic() > end:
                flag.with_suffix(".unheard").touch()
                return
            time.sleep(0.001)


class WaitsTwice(Waits):
    """Call number 6, in the search for a start, waits for a file of that name with the suffix ``.start``."""

    def trajectories(self, x, times):
        if getattr(self.calls, "n", 0) == 5:
            self.wait(Path(os.environ["EN4DVAR_TEST_FLAG"]).with_suffix(".start"))
        return super().trajectories(x, times)


class WaitsAndDies(Waits):
    """Waits so in the data set of large amplitude only, whose iterations that file is about, and dies there, once."""

    at = 11  # its start takes two calls more

    def trajectories(self, x, times):
        return super().trajectories(x, times) if is_large(x) else Oscillator.trajectories(self, x, times)

    def wait(self, flag):
        super().wait(flag)
        died = flag.with_suffix(".died")
        if not died.exists():
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
