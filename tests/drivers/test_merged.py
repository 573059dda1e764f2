"""Small blocks joined: the same samples, and never across anything that is not simply more of the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given, strategies as st

from drivers.base import TEMPERATURE, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from drivers.merged import merged
from tests.support.samples import T0_NS, Cut


def small(cut: Cut, n: int = 1000, sizes: tuple[int, ...] = (10,), rate_hz: float = 100.0) -> list[SampleBlock]:
    return cut(np.arange(3.0 * n).reshape(n, 3), rate_hz, sizes)


@given(sizes=st.lists(st.integers(1, 90), min_size=1, max_size=5), rate=st.sampled_from([100.0, 120.0, 1024.0]))
def test_nothing_is_lost_or_moved(cut: Cut, sizes: list[int], rate: float) -> None:
    blocks = small(cut, 1000, tuple(sizes), rate)
    joined = list(merged(blocks, 2.0))
    assert all(b.n_samples <= 2.0 * rate for b in joined)
    assert np.array_equal(np.concatenate([b.samples for b in joined]), np.concatenate([b.samples for b in blocks]))
    for block in joined:
        assert abs(block.t_ns - T0_NS - round(block.sequence / rate * 1e9)) <= 1
        assert block.samples[0, 0] == 3 * block.sequence
    assert len(joined) <= 2 * 1000 / (2.0 * rate) + 2


def test_a_gap_a_late_clock_and_another_stream_are_left_alone(cut: Cut) -> None:
    blocks = small(cut)
    assert len(list(merged(blocks, 100.0))) == 1
    assert len(list(merged([*blocks[:40], *blocks[41:]], 100.0))) == 2
    assert len(list(merged([*blocks[:40], *blocks[39:]], 100.0))) == 2
    late = [replace(b, t_ns=b.t_ns + 100) for b in blocks[40:]]
    assert len(list(merged([*blocks[:40], *late], 100.0))) == 2
    for other in ({"channels": ("x", "y", "z")}, {"sample_rate_hz": 50.0}, {"unit": "degC"}):
        assert len(list(merged([*blocks[:40], *(replace(b, **other) for b in blocks[40:])], 100.0))) > 1


def test_order_against_other_topics_stays(cut: Cut) -> None:
    blocks = small(cut)
    warm = replace(blocks[40], topic=TEMPERATURE, unit="degC")
    assert [b.topic for b in merged([*blocks[:40], warm, warm, *blocks[40:]], 100.0)] == [
        blocks[0].topic, TEMPERATURE, TEMPERATURE, blocks[0].topic,
    ]  # fmt: skip


def test_large_blocks_pass_untouched(cut: Cut) -> None:
    blocks = small(cut)
    assert all(a is b for a, b in zip(merged(blocks, 0.0), blocks, strict=True))


def test_recordings_are_joined_as_their_blocks_would_be(cut: Cut, tmp_path: Path) -> None:
    """Whatever lies in a chunk, a file or beside it: the same samples in the same order against all else."""
    rng = np.random.default_rng(2)
    blocks = cut(rng.standard_normal((120_000, 3)), 1000.0, [100])
    warm = [replace(b, topic=TEMPERATURE, unit="degC", samples=b.samples[:1]) for b in blocks[700:900:10]]
    for name, part in (("a", blocks[:500]), ("b", [*blocks[500:], *warm])):
        with McapWriter(tmp_path / f"{name}.mcap") as writer:
            for block in sorted(part, key=lambda b: (b.t_ns, b.topic)):
                writer.write(block)
    files = [tmp_path / "b.mcap", tmp_path / "a.mcap"]
    single = list(read_recordings(files))
    joined = list(read_recordings(files, longest_s=10.0))
    assert len(joined) < len(single) / 3

    def laid_out(found: list[SampleBlock]) -> list[tuple[str, int, bytes]]:
        """Sample by sample, with its topic."""
        return [(b.topic, b.sequence + i, row.tobytes()) for b in found for i, row in enumerate(b.samples)]

    assert laid_out(joined) == laid_out(single)
