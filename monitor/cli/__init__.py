"""Command line of the monitor, one module for each group of commands."""

import sys


def main() -> None:
    """Run the command that the command line names."""
    if sys.argv[1:] == ["--version"]:  # answered without typer, which takes a fifth of a second to load
        from monitor import __version__

        print(__version__)
        return
    from monitor.cli.app import main as run

    run()
