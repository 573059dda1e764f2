"""Filter and resampler: independent of the blocks, and exactly the filter that was designed."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy.signal import sosfilt, sosfreqz

from monitor.signals.kernels import filtered
from monitor.signals.resampling import Conditioner

RATES = ["50", "100", "120", "200", "500.5", "1000", "1024", "1024.37"]
every_rate = pytest.mark.parametrize("rate", RATES)
RECORD = np.random.default_rng(0).normal(size=(1500, 2))


def design(rate: str) -> Conditioner:
    return Conditioner.design(float(rate), 100.0, 40.0)


def run(conditioner: Conditioner, samples: np.ndarray, edges: list[int] | None = None) -> np.ndarray:
    state, parts = conditioner.start(samples.shape[1]), []
    for part in np.split(samples, edges or []):
        state, output = conditioner.step_block(state, part)
        parts.append(output)
    return np.concatenate(parts)


def response(conditioner: Conditioner, frequency: float, seconds: float = 12.0) -> complex:
    """Steady complex gain of a tone, referred to the instants k * step of the source's samples."""
    n = round(seconds * conditioner.rate_in_hz)
    tone = np.sin(2.0 * np.pi * frequency * np.arange(n) / conditioner.rate_in_hz)[:, None]
    output = run(conditioner, tone)[:, 0]
    phase = 2.0 * np.pi * frequency * np.arange(output.size) * float(conditioner.step) / conditioner.rate_in_hz
    late = slice(output.size // 2, None)  # the transient has died away
    basis = np.column_stack([np.sin(phase), np.cos(phase)])[late]
    a, b = np.linalg.lstsq(basis, output[late], rcond=None)[0]
    assert np.abs(basis @ [a, b] - output[late]).max() < 1e-4, "more than one tone comes out"
    return complex(a, b)


def designed(conditioner: Conditioner, frequency: float) -> complex:
    _, h = sosfreqz(conditioner.sos, worN=[frequency], fs=conditioner.rate_in_hz)
    return complex(h[0])


@pytest.mark.parametrize("n_channels", [1, 3, 9])
def test_sections_are_filtered_as_scipy_does(n_channels: int) -> None:
    rng = np.random.default_rng(1)
    x, memory = rng.normal(size=(500, n_channels)), rng.normal(size=(4, 2, n_channels))
    wanted = sosfilt(design("1024").sos, x, axis=0, zi=memory)
    for got, want in zip(filtered(design("1024").sos, x, memory), wanted, strict=True):
        np.testing.assert_array_equal(got, want)


@every_rate
@given(edges=st.sets(st.integers(1, len(RECORD) - 1), max_size=12).map(sorted))
@example(edges=list(range(1, len(RECORD))))
@settings(deadline=None, max_examples=20)
def test_any_split_into_blocks_gives_the_same_bits(rate: str, edges: list[int]) -> None:
    conditioner = design(rate)
    np.testing.assert_array_equal(run(conditioner, RECORD, edges), run(conditioner, RECORD))


@every_rate
@given(n=st.integers(1, 5000))
@settings(deadline=None, max_examples=20)
def test_t_seconds_give_t_times_the_rate_rounded_up(rate: str, n: int) -> None:
    out_hz = min(Fraction(100), Fraction(rate))
    assert len(run(design(rate), np.zeros((n, 1)))) == ceil(n * out_hz / Fraction(rate))


@every_rate
def test_the_ratio_of_rates_is_exact_to_1e_6(rate: str) -> None:
    conditioner = design(rate)
    assert conditioner.rate_hz == min(100.0, float(rate))
    assert float(conditioner.step) == pytest.approx(float(rate) / conditioner.rate_hz, rel=1e-6)


@every_rate
def test_the_passband_is_flat_to_a_twentieth_of_a_decibel(rate: str) -> None:
    conditioner = design(rate)
    assert conditioner.cutoff_hz == min(40.0, 0.4 * float(rate))
    for frequency in np.linspace(0.5, 0.9 * conditioner.cutoff_hz, 9):
        assert abs(20.0 * np.log10(abs(response(conditioner, float(frequency))))) < 0.0505


@every_rate
def test_a_resampled_sine_is_the_analytically_filtered_sine_delayed_by_whole_source_samples(rate: str) -> None:
    conditioner = design(rate)
    delay = conditioner.taps.shape[1] // 2
    for frequency in (0.7, 3.1, 11.9, 17.3, 27.7, 35.9):
        if frequency < 0.95 * conditioner.cutoff_hz:
            shift = np.exp(-2j * np.pi * frequency * delay / conditioner.rate_in_hz)
            assert abs(response(conditioner, frequency) - designed(conditioner, frequency) * shift) < 1e-4


@every_rate
@pytest.mark.parametrize("frequency", [55.3, 59.0, 73.0, 96.2, 104.7, 197.0, 231.0, 430.0])
def test_what_would_alias_is_attenuated_as_designed(rate: str, frequency: float) -> None:
    conditioner = design(rate)
    if frequency < 0.5 * conditioner.rate_in_hz:
        wanted = abs(designed(conditioner, frequency))
        assert wanted < 10 ** (-34.0 / 20.0)
        assert abs(response(conditioner, frequency)) < 1.01 * wanted + 10 ** (-90.0 / 20.0)


def test_a_source_slower_than_wanted_keeps_its_rate_and_gets_a_lower_cutoff() -> None:
    conditioner = design("50")
    assert (conditioner.rate_hz, conditioner.step, conditioner.cutoff_hz) == (50.0, 1, 20.0)
    assert abs(designed(conditioner, 24.0)) < 0.1


@every_rate
def test_channels_do_not_touch_each_other(rate: str) -> None:
    conditioner = design(rate)
    together = run(conditioner, RECORD)
    for channel in range(2):
        np.testing.assert_array_equal(together[:, [channel]], run(conditioner, RECORD[:, [channel]]))
