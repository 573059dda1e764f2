"""One hop of a 400 s window beside its floor and beside what others need for the window; and how it grows."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import cycle
from typing import Any

import numpy as np
from scipy.linalg import lapack

from monitor.config import Configuration
from monitor.core import Array, ModalEstimate, Window
from monitor.identification import identify
from monitor.identification.eigen import upper_poles
from monitor.pipeline import Pipeline
from monitor.signals import windows
from monitor.signals.kernels import lag_products
from tests.benchmarks.frames import T0_NS, Hops, baseline, configuration, floors
from tests.benchmarks.rounds import Cost, interleaved
from tests.support.simulated import windows_of

FLOOR, PLAIN, FULL = "floor of a hop", "hop without uncertainty", "hop with uncertainty, refinement, updating, alarm"
LEAST = "matrix work of a hop without uncertainty"
UNREFINED = "hop with uncertainty, updating, alarm, without refinement"
FOUND, FOUND_UNC = "its identification alone", "its identification alone, with uncertainty"
_LEAST_S = 0.03
"""For which each is called over and over: hops follow one another, as in a replay."""
PYOMA, PYOMA_1 = "pyOMA2 cov, step 2 (our orders)", "pyOMA2 cov, step 1 (its default)"
PYOMA_UNC, PYOMA_UNC_1 = "pyOMA2 cov, uncertainty, step 2", "pyOMA2 cov, uncertainty, step 1"
KOMA = "koma cov"


def floor(samples: Array, big: Array) -> None:
    """The numpy work below which no such hop can go: lagged products, one SVD, fifteen eigenproblems."""
    for tau in range(50):
        samples[: 1000 - 49].T @ samples[tau : tau + 1000 - 49]
    np.linalg.svd(big)
    for order in range(2, 31, 2):
        np.linalg.eig(big[:order, :order])


def least(samples: Array, big: Array) -> None:
    """The matrix work of a hop without uncertainty and nothing else: lagged products, and LAPACK called bare."""
    columns = np.ascontiguousarray(samples.T)
    lag_products(columns, 1000 - 49, 50)
    lag_products(columns, 49, 50)
    square = big @ big.T
    for _ in range(2):
        lapack.dtrtri(lapack.dpotrf(square)[0])
    reflected, diagonal, beside, scales, _ = lapack.dsytrd(square, lower=1)
    _, turned, _ = lapack.dstevd(diagonal, beside)
    lapack.dormqr("L", "N", reflected[1:, :-1], scales, turned[1:, -30:], 64 * 30)
    triangular, scales, *_ = lapack.dgeqrf(big[:72, :30])
    lapack.dorgqr(triangular, scales)
    upper_poles(big[:30, :30], big[:3, :30], range(2, 31, 2))


class Identification:
    """What a hop does of what peers do: lag sums, realisation, poles, and beyond them which are modes and whose."""

    def __init__(self, uncertainty: bool) -> None:
        self.config = configuration(refined=False, uncertainty=uncertainty)
        self.modes = self.config.model().modes()
        p, rows = self.config.processing, self.config.identification.block_rows
        self.grid = windows.WindowGrid.design(100.0, p.window_s, p.hop_s, 2 * rows, 0.0)
        self.state = windows.start(self.grid, 3, index=0)
        motion = floors(self.config, p.window_s + 20 * p.hop_s, 100.0, 2)
        self._pieces = cycle(np.split(motion, len(motion) // 1000))
        self.found: ModalEstimate | None = None
        while self.found is None:
            self()

    def __call__(self) -> None:
        """Take in the next hop."""
        c = self.config
        self.state, found = windows.step(self.grid, self.state, next(self._pieces), 0)
        for item in found:
            assert isinstance(item, Window)
            known = tuple(range(3)), self.modes, c.instrumented().sensor_matrix
            modes = identify(item, *known, c.identification, c.selection, cutoff_hz=c.processing.cutoff_hz)
            assert isinstance(modes, ModalEstimate)
            self.found = modes


def peers(x: Array) -> dict[str, Callable[[], Any]]:
    """What is installed of those that identify a window as a whole."""
    found: dict[str, Callable[[], Any]] = {}
    with suppress(ImportError):
        os.environ["TQDM_DISABLE"] = "1"
        with warnings.catch_warnings(action="ignore"):
            from pyoma2.functions import ssi
        np.seterr(all="warn")  # that import changes it
        logging.disable(logging.INFO)

        def pyoma(uncertainty: bool, step: int) -> Any:
            hankel, t = ssi.build_hank(x.T, x.T, 25, "cov", calc_unc=uncertainty, nb=50)
            o, a, c, _ = ssi.SSI_fast(hankel, 25, 30, step=step)
            return ssi.SSI_poles(o, a, c, 30, 0.01, step=step, calc_unc=uncertainty, H=hankel, T=t)

        found[PYOMA] = lambda: pyoma(False, 2)
        found[PYOMA_1] = lambda: pyoma(False, 1)
        found[PYOMA_UNC] = lambda: pyoma(True, 2)
        found[PYOMA_UNC_1] = lambda: pyoma(True, 1)
    with suppress(ImportError):
        with warnings.catch_warnings(action="ignore"):
            from koma.oma import covssi
        found[KOMA] = lambda: covssi(x, 100.0, 25, list(range(2, 31, 2)), showinfo=False)
    return found


def compare(rounds: int) -> dict[str, Cost]:
    """Costs of a hop and of its peers."""
    config = configuration()
    healthy = baseline(config)
    x = floors(config, 400.0, 100.0, 3)
    samples, big = x[:1000], np.random.default_rng(0).standard_normal((75, 75))
    things = {
        FLOOR: lambda: floor(samples, big),
        LEAST: lambda: least(samples, big),
        PLAIN: Hops(configuration(refined=False, uncertainty=False), healthy),
        UNREFINED: Hops(configuration(refined=False), healthy),
        FULL: Hops(config, healthy),
        FOUND: Identification(uncertainty=False),
        FOUND_UNC: Identification(uncertainty=True),
        **peers(x),
    }
    return interleaved(things, rounds, _LEAST_S)


def accuracy(count: int) -> dict[str, Array]:
    """RMS errors of the frequencies over so many windows, the same ones for all, in percent."""
    ours = {PLAIN: configuration(refined=False, uncertainty=False), FULL: configuration()}
    truth = ours[FULL].model().modes().frequencies_hz
    errors: dict[str, list[Array]] = {}
    for seed in range(count):
        x = floors(ours[FULL], 400.0, 100.0, 100 + seed)
        found = {name: _identified(config, x) for name, config in ours.items()}
        others = peers(x)
        if PYOMA in others:  # its poles at order 14; the nearest to the truth, which flatters
            poles = others[PYOMA]()[0][:, 7]
            found[PYOMA] = np.array([poles[np.nanargmin(np.abs(poles - f))] for f in truth])
        for name, frequencies in found.items():
            errors.setdefault(name, []).append(100.0 * (frequencies / truth - 1.0))
    return {name: np.sqrt(np.mean(np.square(each), axis=0)) for name, each in errors.items()}


def _identified(config: Configuration, x: Array) -> Array:
    """Frequencies of the one window of `x`, as the pipeline finds them."""
    (modes,) = [r.modes for r in windows_of(Pipeline(config), x, 100.0, t0_ns=T0_NS, size=1000)]
    return modes.frequencies_hz


def cold(rounds: int) -> dict[str, Cost]:
    """Costs of single hops between others' work that empties the caches, as a daemon's that comes once in 10 s."""
    healthy, x = baseline(configuration()), np.random.default_rng(0).standard_normal((600, 600))
    things = {
        "others' work": lambda: np.linalg.svd(x),
        PLAIN: Hops(configuration(refined=False, uncertainty=False), healthy),
        "others' work again": lambda: np.linalg.svd(x),
        FULL: Hops(configuration(), healthy),
    }
    costs = interleaved(things, rounds)
    return {name: costs[name] for name in (PLAIN, FULL)}


def growth(rounds: int, channels: tuple[int, ...]) -> dict[str, list[tuple[float, Cost]]]:
    """Cost of one hop by channels (and stories), window length, and rate of the source."""

    def cost(hops: Hops, most: int = rounds) -> Cost:
        return interleaved({"hop": hops}, min(rounds, most))["hop"]

    by_rate = {hz: Hops(configuration(), rate_hz=hz) for hz in (100.0, 1024.0, 4096.0)}
    return {
        "channels = stories": [(n, cost(Hops(configuration(n)), rounds if n < 30 else 3)) for n in channels],
        "window, s": [(s, cost(Hops(configuration(window_s=s)))) for s in (100.0, 400.0, 1600.0)],
        "source rate, Hz": [(hz, cost(hops)) for hz, hops in by_rate.items()],
    }
