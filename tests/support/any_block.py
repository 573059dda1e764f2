"""Any block that the vocabulary allows, and when two are the same."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from drivers.base import UNITS, SampleBlock


@st.composite
def blocks(draw: st.DrawFn) -> SampleBlock:
    """Any block that the vocabulary allows, NaN and infinite samples among them."""
    channels = tuple(draw(st.lists(st.text(max_size=5), min_size=1, max_size=4)))
    shape = (draw(st.integers(0, 20)), len(channels))
    return SampleBlock(
        topic="/acceleration",
        t_ns=draw(st.integers(0, 2**61)),
        sequence=draw(st.integers(0, 2**61)),
        sample_rate_hz=draw(st.floats(1e-3, 1e7)),
        channels=channels,
        unit=draw(st.sampled_from(UNITS)),
        samples=draw(hnp.arrays(np.float32, shape, elements=st.floats(width=32))),
    )


def same(left: SampleBlock, right: SampleBlock) -> bool:
    """Equal in every field, NaN equal to NaN."""
    fields = ("topic", "t_ns", "sequence", "sample_rate_hz", "channels", "unit")
    return all(getattr(left, name) == getattr(right, name) for name in fields) and np.array_equal(
        left.samples, right.samples, equal_nan=True
    )
