"""The lowpass is SciPy's, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.signal import cheby1

from monitor.signals.chebyshev import chebyshev_lowpass


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 128.0, 200.0, 250.0, 256.0, 1000.0, 1024.0, 4096.0, 51200.0])
@pytest.mark.parametrize("cutoff_hz", [40.0, 20.0, 12.5])
def test_the_sections_are_scipy_s_to_the_last_bit(rate_hz: float, cutoff_hz: float) -> None:
    cutoff_hz = min(cutoff_hz, 0.4 * rate_hz)
    expected = cheby1(8, 0.05, cutoff_hz, fs=rate_hz, output="sos")
    np.testing.assert_array_equal(chebyshev_lowpass(8, 0.05, cutoff_hz, rate_hz), expected)


@given(
    half_order=st.integers(1, 6),
    ripple_db=st.floats(0.01, 3.0),
    share=st.floats(0.001, 0.49),
    rate_hz=st.floats(1.0, 1e5),
)
def test_any_design_is_scipy_s(half_order: int, ripple_db: float, share: float, rate_hz: float) -> None:
    order, cutoff_hz = 2 * half_order, share * rate_hz
    expected = cheby1(order, ripple_db, cutoff_hz, fs=rate_hz, output="sos")
    np.testing.assert_allclose(chebyshev_lowpass(order, ripple_db, cutoff_hz, rate_hz), expected, rtol=1e-9)
