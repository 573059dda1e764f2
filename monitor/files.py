"""Files that are whole or not there."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path


def partial(path: Path) -> Path:
    """Where a file is written before it takes its final name."""
    return path.with_name(path.name + ".part")


def finish(path: Path) -> None:
    """Give the partial file of `path` its final name."""
    os.replace(partial(path), path)


def write_atomically(path: Path, text: str) -> None:
    """Write a small text file under its final name only when complete."""
    temporary = partial(path)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        finish(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def sha256(path: Path) -> str:
    """Checksum of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
