"""User errors, distinguished by the exit code that the commands return."""

from __future__ import annotations


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
