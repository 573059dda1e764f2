"""User errors, distinguished by the exit code that the commands return."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class UserError(Exception):
    """Error with one clear message that names the file, the place and the remedy; never shown with a traceback."""

    exit_code = 1


class WrongUsageError(UserError):
    """Call of a command in a way that makes no sense, for example with an output in the place of an input."""

    exit_code = 2


class BadInputError(UserError):
    """Data that cannot be used: missing channel, unknown unit, unreadable bytes, too short."""

    exit_code = 65


class MissingInputError(UserError):
    """Named file that does not exist, cannot be read, or is a directory."""

    exit_code = 66


class BadConfigurationError(UserError):
    """Configuration that contradicts itself or names unknown keys; every problem is listed."""

    exit_code = 78


class InUseError(BadConfigurationError):
    """Output folder into which another daemon writes."""


class NoResourcesError(UserError):
    """Lack of memory, or of allowed processes, for the requested computation."""


@contextmanager
def os_errors_of(what: object, says: str = "") -> Iterator[None]:
    """Raise an OSError of the block as MissingInputError, which names a file or another place, and `says` what cannot be.

    Examples
    --------
    >>> with os_errors_of("a.txt", "cannot be read: "):
    ...     open("no folder/a.txt")
    Traceback (most recent call last):
    ...
    monitor.core.errors.MissingInputError: a.txt: cannot be read: No such file or directory
    """
    try:
        yield
    except OSError as error:
        raise MissingInputError(f"{what}: {says}{error.strerror or error}") from error
