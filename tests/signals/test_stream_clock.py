"""The rate of a stream by its timestamps: over gaps, with jitter, and what the pipeline says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import ACCELERATION, SampleBlock
from monitor.config import Configuration
from monitor.core import WindowResult
from monitor.model import Model
from monitor.pipeline import Pipeline
from monitor.signals import alignment
from tests.support.frames import shear_frame
from tests.support.learned import baseline_of
from tests.support.samples import CHANNELS, T0_NS
from tests.support.simulated import PAPER_FRAME, ambient

RATE = 100.0


def blocks(
    values: np.ndarray, stamped_hz: float, size: int = 100, jitter_s: float = 0.0, first: int = 0
) -> list[SampleBlock]:
    """Blocks that state 100 Hz, with stamps of another rate."""
    draw, out = np.random.default_rng(4), []
    for k in range(0, len(values) - size + 1, size):
        t_ns = T0_NS + round(((first + k) / stamped_hz + jitter_s * draw.normal()) * 1e9)
        part = values[k : k + size].astype(np.float32)
        out.append(SampleBlock(ACCELERATION, t_ns, first + k, RATE, CHANNELS, "m/s^2", part))
    return out


def aligned(*parts: SampleBlock) -> alignment.AlignState:
    state = alignment.start()
    for block in parts:
        state, _ = alignment.step(state, block, CHANNELS)
    return state


STILL = np.zeros((40_000, 3))


@pytest.mark.parametrize("size", [7, 100, 1000])
def test_exact_stamps_have_exactly_the_stated_rate(size: int) -> None:
    assert aligned(*blocks(STILL, RATE, size)).clock.ratio == 1.0


@pytest.mark.parametrize("stamped_hz", [98.0, 99.5, 99.8, 99.99, 100.3, 102.0])
def test_the_rate_by_the_stamps_is_found_although_the_clock_makes_gaps(stamped_hz: float) -> None:
    clock = aligned(*blocks(STILL, stamped_hz)).clock
    assert clock.ratio * RATE == pytest.approx(stamped_hz, abs=2e-4)


@pytest.mark.parametrize("jitter_s", [0.0005, 0.02])
def test_jitter_of_stamps_is_no_other_rate(jitter_s: float) -> None:
    ratio = aligned(*blocks(STILL, RATE, jitter_s=jitter_s)).clock.ratio
    deviation = jitter_s * np.sqrt(12.0 / 400.0) / 400.0  # of the slope of a line through 400 stamps in 400 s
    assert abs(ratio - 1.0) < 4.0 * deviation + 1e-6


def test_pauses_are_no_other_rate() -> None:
    state = aligned(*blocks(STILL, RATE), *blocks(STILL, RATE, first=60_000), *blocks(STILL, RATE, first=900_000))
    assert state.clock.ratio == 1.0


def test_a_stream_that_changes_its_stated_rate_begins_anew() -> None:
    slow = [replace(b, sample_rate_hz=50.0) for b in blocks(STILL, 50.0, first=100_000)]
    assert aligned(*blocks(STILL, 98.0), *slow).clock.ratio == 1.0


def site(window_s: float) -> Configuration:
    frame = PAPER_FRAME.masses_kg, PAPER_FRAME.stiffness_n_per_m
    return shear_frame(*frame, processing={"window_s": window_s, "hop_s": 10.0})


def results_of(pipeline: Pipeline, parts: list[SampleBlock]) -> list[WindowResult]:
    return [r for block in parts for r in pipeline.push(block) if isinstance(r, WindowResult)]


@pytest.fixture(scope="module")
def motion() -> np.ndarray:
    return ambient(Model(PAPER_FRAME), 300.0, RATE, 5)


def test_what_the_clock_leaves_open_widens_the_loss_that_would_be_seen(motion: np.ndarray) -> None:
    healthy = baseline_of(site(60.0), results_of(Pipeline(site(60.0)), blocks(motion, RATE)))
    exact, off, alike = (
        results_of(Pipeline(site(60.0), replace(healthy, clock_ratio=ratio)), blocks(motion, stamped_hz))[-1]
        for ratio, stamped_hz in ((1.0, RATE), (1.0, 99.8), (0.998, 99.8))
    )
    assert off.rates_hz == pytest.approx((RATE, 99.8), abs=1e-3)
    assert exact.detectable_loss is not None and off.detectable_loss is not None and alike.detectable_loss is not None
    np.testing.assert_allclose(off.detectable_loss - exact.detectable_loss, 0.004, atol=1e-5)
    np.testing.assert_allclose(alike.detectable_loss, exact.detectable_loss, atol=1e-5)


def test_a_gap_that_the_clock_makes_is_told_as_the_clocks(motion: np.ndarray) -> None:
    said = [r.skipped for r in results_of(Pipeline(site(100.0)), blocks(motion, 98.0))]
    reasons = {s.reason for s in said if s is not None}
    assert reasons == {"the clock and the stated rate are at odds (98 Hz and 100 Hz)"}
    assert all("shorter" not in s.mend for s in said if s is not None)
