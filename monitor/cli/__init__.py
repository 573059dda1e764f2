"""Command line of the monitor, one module for each group of commands."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from click import Group


def main() -> None:
    """Run the command that the command line names."""
    if sys.argv[1:] == ["--version"]:  # answered without typer, which takes a fifth of a second to load
        from monitor import __version__

        print(__version__)
        return
    from monitor.cli.app import main as run

    run()


def command_line() -> Group:
    """Return the commands with their arguments and options, for those who read a command line without running it."""
    from typing import cast

    import typer

    from monitor.cli.app import app

    return cast("Group", typer.main.get_command(app))
