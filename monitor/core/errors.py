"""What a user can do wrong, told apart by the exit code that the commands return."""

from __future__ import annotations


class UserError(Exception):
    """One clear message that names the file, the place and the mend; never shown with a traceback."""

    exit_code = 1


class WrongUsageError(UserError):
    """The command was called in a way that makes no sense, as with an output in the place of an input."""

    exit_code = 2


class BadInputError(UserError):
    """The data cannot be used: missing channel, unknown unit, unreadable bytes, too short."""

    exit_code = 65


class MissingInputError(UserError):
    """A named file does not exist, cannot be read, or is a directory."""

    exit_code = 66


class BadConfigurationError(UserError):
    """The configuration contradicts itself or names unknown keys; every problem is listed."""

    exit_code = 78


class NoResourcesError(UserError):
    """The machine has too little memory, or allows too few processes, for what was asked."""
