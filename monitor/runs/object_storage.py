"""Recordings in object storage (``s3://BUCKET/NAME``): listed, identified, and copied to this machine while they are used.

`Path` takes one of the two slashes of an address; such a path, ``s3:/BUCKET/NAME``, stands for the object here.
Access is as for every program on S3: by the variables AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL or the files
in ``~/.aws``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import methodcaller
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drivers.base import RecordingError
from monitor.core import MissingInputError, UserError, import_extra

_SCHEME = "s3:/"
_MAGIC = re.compile(r"[*?\[]")


def is_remote(path: Path) -> bool:
    """Say whether a path stands for an object.

    Examples
    --------
    >>> [is_remote(Path(name)) for name in ("s3://house/a.mcap", "house/a.mcap")]
    [True, False]
    """
    return str(path).startswith(_SCHEME)


def address(path: Path) -> str:
    """Return the address of an object; of a file, its path.

    Examples
    --------
    >>> address(Path("s3://house/a.mcap"))
    's3://house/a.mcap'
    """
    return f"s3://{_key(path)}" if is_remote(path) else str(path)


def remote_paths(pattern: str) -> list[Path]:
    """List the objects that an address with ``*``, ``?`` or ``**`` denotes; one without names one object (errors as `_asked`)."""
    if not _MAGIC.search(pattern):
        return [Path(pattern)]
    found: list[str] = _asked(pattern, methodcaller("glob", pattern))
    return [Path(f"s3://{name}") for name in sorted(found)] or [Path(pattern)]


def remote_version(path: Path) -> str:
    """Identify the present version of an object by its address, its size and its ETag (errors as `_asked`)."""
    about = _asked(address(path), methodcaller("info", _key(path)))
    return f"{address(path)} {about['size']} {about['ETag']}"


@contextmanager
def local_copies(paths: Sequence[Path]) -> Iterator[tuple[list[Path], Callable[[str], str]]]:
    """Give files to read: copies of objects, which are removed afterwards, and the files themselves.

    Beside them comes a function that names objects instead of copies in a text.  It is applied to errors of users and
    recordings. Raises MissingExtraError if the extra `s3` is not installed, MissingInputError if an object cannot be read.
    """
    if not any(map(is_remote, paths)):
        yield list(paths), str
        return
    with TemporaryDirectory(prefix="shm-") as name:
        copies = [Path(name, str(i), path.name) if is_remote(path) else path for i, path in enumerate(paths)]
        for path, copy in zip(paths, copies, strict=True):
            if is_remote(path):
                copy.parent.mkdir()
                _asked(address(path), methodcaller("get_file", _key(path), str(copy)))

        def named(text: str) -> str:
            for path, copy in zip(paths, copies, strict=True):
                text = text.replace(str(copy), address(path))
            return text

        try:
            yield copies, named
        except (UserError, RecordingError) as error:
            raise type(error)(named(str(error))) from error


def _key(path: Path) -> str:
    """Return bucket and name of an object."""
    return str(path).removeprefix(_SCHEME)


def _asked(what: str, question: Callable[[Any], Any]) -> Any:
    """Ask the storage; MissingExtraError without the extra `s3`, MissingInputError in one line for what the storage refuses."""
    storage = import_extra("s3fs", what).S3FileSystem(skip_instance_cache=True, use_listings_cache=False)
    try:
        return question(storage)
    except FileNotFoundError as error:
        raise MissingInputError(f"{what}: there is no such object") from error
    except Exception as error:  # of botocore, aiohttp or s3fs: they have no base in common
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MissingInputError(f"{what}: cannot be read: {reason}") from error
