"""A quake of twenty seconds, and the frame that it shakes."""

from __future__ import annotations

from functools import cache

import numpy as np

from tests.events.shaken import RATE, Shaken, kanai_tajimi, shake
from tests.support.shaken_site import SITE

BEGIN_S, END_S = 30.0, 50.0


@cache
def shaken() -> Shaken:
    """75 s with a quake of 20 s at 30 s."""
    wave = np.zeros(round(75.0 * RATE))
    quake = kanai_tajimi(END_S - BEGIN_S, 1.0, 2.5, np.random.default_rng(3))
    wave[round(BEGIN_S * RATE) :][: quake.size] += quake
    return shake(wave, np.random.default_rng(4))[0]


STRUCTURE = SITE[SITE.index("[structure]") :]
