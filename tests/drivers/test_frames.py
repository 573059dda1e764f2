"""A DBC compiled to array operations gives what cantools gives, and back."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers import frames
from drivers.frames import FrameError

SHIPPED = Path(__file__).parents[2] / "deploy" / "frame.dbc"
CHANNELS = ("a1", "a2", "a3")
HEAD = 'VERSION ""\nBU_: DAQ\n'


def dbc(folder: Path, *messages: str) -> Path:
    path = folder / "test.dbc"
    path.write_text(HEAD + "\n".join(messages) + "\n")
    return path


def message(signals: list[str], *, frame_id: int = 256, length: int = 8, name: str = "M") -> str:
    return f"BO_ {frame_id} {name}: {length} DAQ\n" + "".join(f" SG_ {signal} Vector__XXX\n" for signal in signals)


def test_the_shipped_layout() -> None:
    (layout,) = frames.load(SHIPPED, CHANNELS)
    assert (layout.frame_id, layout.extended, layout.n_bytes, layout.counter_bits) == (256, False, 8, 16)
    samples, counters = layout.decode(bytes([0xE8, 0x03, 0x18, 0xFC, 0xFF, 0x7F, 0x34, 0x12]))
    np.testing.assert_array_equal(samples, np.float32([[1.0, -1.0, 32.767]]))
    assert counters.tolist() == [0x1234]


@given(data=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20))
def test_any_bytes_give_what_cantools_gives(data: list[bytes]) -> None:
    (layout,) = frames.load(SHIPPED, CHANNELS)
    database = cantools.database.load_file(SHIPPED)
    samples, counters = layout.decode(b"".join(data))
    for at, frame in enumerate(data):
        expected = database.decode_message(256, frame)
        assert [*samples[at], counters[at]] == [*np.float32([expected[c] for c in CHANNELS]), expected["counter"]]


@st.composite
def signals(draw: st.DrawFn) -> tuple[list[str], int]:
    """Signals of any length, sign and byte order, one behind the other."""
    out, bit = [], 0
    for at in range(draw(st.integers(1, 5))):
        length, big, signed = draw(st.integers(2, 24)), draw(st.booleans()), draw(st.booleans())
        bit = -(-bit // 8) * 8  # so that both byte orders keep to their own bytes
        start = bit + 7 if big else bit
        out.append(
            f'x{at} : {start}|{length}@{int(not big)}{"-" if signed else "+"} (0.25,{draw(st.integers(-9, 9))}) [0|0] ""'
        )
        bit += length
    return out, -(-bit // 8)


@settings(deadline=None)
@given(layout=signals(), seed=st.integers(0, 99))
def test_any_layout_gives_what_cantools_gives_and_packs_back(
    tmp_path_factory: pytest.TempPathFactory, layout: tuple[list[str], int], seed: int
) -> None:
    path = dbc(tmp_path_factory.mktemp("dbc"), message(layout[0], length=layout[1]))
    names = tuple(f"x{at}" for at in range(len(layout[0])))
    (compiled,) = frames.load(path, names)
    data = np.random.default_rng(seed).integers(0, 256, (10, layout[1]), dtype=np.uint8)
    samples, _ = compiled.decode(data.tobytes())
    database = cantools.database.load_file(path)
    expected = [[database.decode_message(256, row.tobytes())[name] for name in names] for row in data]
    np.testing.assert_array_equal(samples, np.float32(expected))
    packed, saturated = compiled.encode(samples.astype(float), np.zeros(10, np.int64))
    np.testing.assert_array_equal(compiled.decode(packed.tobytes())[0], samples)
    assert saturated == 0


def test_fd_frames_carry_several_samples(tmp_path: Path) -> None:
    parts = [f'a{c}_{k} : {16 * (2 * k + c - 1)}|16@1- (0.001,0) [0|0] "m/s^2"' for k in range(10) for c in (1, 2)]
    path = dbc(tmp_path, message([*parts, 'counter : 320|32@1+ (1,0) [0|0] ""'], length=48))
    for layout in (frames.load(path, ("a1", "a2"))[0], frames.load(path)[0]):
        assert (layout.channels, layout.n_samples) == (("a1", "a2"), 10)
        raw = np.arange(-40, 40).reshape(4, 20)
        data, _ = layout.encode((raw * 0.001).reshape(-1, 2), np.array([7, 17, 27, 37]))
        samples, counters = layout.decode(data.tobytes())
        np.testing.assert_array_equal(samples, np.float32(raw.reshape(-1, 2) * 0.001))
        assert counters.tolist() == [7, 17, 27, 37]


def test_one_message_a_channel_in_the_channels_order(tmp_path: Path) -> None:
    count = 'counter : 16|16@1+ (1,0) [0|0] ""'
    nodes = [
        message([f'a{at} : 0|16@1- (1,0) [0|0] "mg"', count], frame_id=0x80000100 + at, length=4, name=f"N{at}")
        for at in (2, 1)
    ]
    layouts = frames.load(dbc(tmp_path, *nodes), ("a1", "a2"))
    assert [(layout.name, layout.frame_id, layout.extended) for layout in layouts] == [
        ("N1", 0x101, True),
        ("N2", 0x102, True),
    ]
    np.testing.assert_allclose(layouts[0].decode(bytes([0xE8, 3, 5, 0]))[0], 9.80665, rtol=1e-6)


def test_real_numbers_and_saturation(tmp_path: Path) -> None:
    path = dbc(
        tmp_path,
        message(['a1 : 0|32@1- (1,0) [0|0] "m/s^2"', 'a2 : 32|8@1+ (1,0) [0|0] "m/s^2"']),
        "SIG_VALTYPE_ 256 a1 : 1;",
    )
    (layout,) = frames.load(path, ("a1", "a2"))
    data, saturated = layout.encode(np.array([[1.5, 300.0], [-2.25, -1.0], [0.0, 255.0]]), np.zeros(3, np.int64))
    samples, _ = layout.decode(data.tobytes())
    np.testing.assert_array_equal(samples, [[1.5, 255.0], [-2.25, 0.0], [0.0, 255.0]])
    assert saturated == 2


A1 = 'a1 : 0|16@1- (0.001,0) [0|0] "m/s^2"'


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        ([message(['b : 0|16@1- (1,0) [0|0] ""'])], "no signal 'a1'; the signals are b"),
        ([message([A1]), message([A1], frame_id=1, name="N")], "'a1' stands in M, N"),
        ([message(['a1 : 0|16@1- (1,0) [0|0] "bar"'])], "a1 has unit 'bar'"),
        ([message(['a1 : 0|16@1- (0,0) [0|0] "g"'])], "factor 0"),
        ([message([A1, 'counter : 16|16@1- (1,0) [0|0] ""'])], "counter must be unsigned"),
        ([message(['s M : 0|8@1+ (1,0) [0|0] ""', 'a1 m0 : 8|16@1- (1,0) [0|0] "g"'])], "multiplexed"),
        (["BO_ what"], "is no DBC"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_name(tmp_path: Path, messages: list[str], reason: str) -> None:
    path = dbc(tmp_path, *messages)
    with pytest.raises(FrameError, match=reason) as caught:
        frames.load(path, ("a1",))
    assert str(path) in str(caught.value)


def test_a_missing_dbc(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="No such file"):
        frames.load(tmp_path / "none.dbc", ("a1",))
