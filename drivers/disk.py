"""Files that exist under their final name only when they are complete, and folders whose new names outlast a crash."""

from __future__ import annotations

import os
import stat
from errno import EINVAL
from pathlib import Path

PRIVATE_FOLDER = 0o700
"""Mode of a folder that its owner alone may enter. [mode; definition]"""
_PIECE_BYTES = 1 << 20
"""Length of what is compared at once. [bytes; cost: it is held in memory]"""


def destination(path: Path) -> Path:
    """Return the file that is written where `path` is named: what a link leads to, so that the link stays.

    Raises `OSError` if a device, a pipe or a socket stands there, which no file may replace.
    """
    place = Path(os.path.realpath(path)) if path.is_symlink() else path
    # /dev/stdout leads to a pipe that has no name, which only `path` itself tells
    if (path.exists() and not (path.is_file() or path.is_dir())) or (place.is_symlink() and not place.exists()):
        raise OSError(EINVAL, "is no regular file; name another place", str(path))
    return place


def partial(path: Path) -> Path:
    """Return the path under which a file is written before it gets its final name.

    Raises `OSError` as `destination`, and if what stands under that path is no regular file.

    Examples
    --------
    >>> partial(Path("day.mcap")).name
    'day.mcap.part'
    """
    place = destination(path)
    part = place.with_name(place.name + ".part")
    if os.path.lexists(part) and not stat.S_ISREG(part.lstat().st_mode):
        raise OSError(EINVAL, "is no regular file; remove it", str(part))
    return part


def finish(path: Path) -> None:
    """Rename the partial file of `path` to its final name."""
    os.replace(partial(path), destination(path))


def private(path: str, flags: int) -> int:
    """Open a file that its owner alone may read and write, whatever the umask: an opener for `open`."""
    handle = os.open(path, flags, 0o600)
    try:
        os.fchmod(handle, 0o600)  # one that was there may have another mode
    except OSError:
        os.close(handle)
        raise
    return handle


def begins_with(path: Path, beginning: Path) -> bool:
    """Return whether a file begins with all of another one."""
    with path.open("rb") as file, beginning.open("rb") as other:
        while data := other.read(_PIECE_BYTES):
            if file.read(len(data)) != data:
                return False
    return True


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk; raises OSError if that fails."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
