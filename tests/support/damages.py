"""Ways in which a file of saved state is damaged."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

DEEP = "[" * 100_000


def put_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()
    (path / "more").write_text("")


def put_dangling_link(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.parent / "nowhere" / "else")


def flip_bits(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for k in range(0, len(data), max(1, len(data) // 20)):
        data[k] ^= 0x40
    path.write_bytes(data)


def put_after(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(path.read_bytes() + data)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "nested": lambda path: path.write_text(DEEP + "\n"),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\n" * 100),
    "zeros": lambda path: path.write_bytes(bytes(5000)),
    "zeros after it": put_after(bytes(5000)),
    "half a long line after it": put_after(b"x" * 3_000_000),
    "empty": lambda path: path.write_bytes(b""),
    "half of it": lambda path: os.truncate(path, path.stat().st_size // 2),
    "bits": flip_bits,
    "a folder": put_folder,
    "a dangling link": put_dangling_link,
}
