"""The command line: one module a group of commands."""

import sys


def main() -> None:
    """Run the command that the command line names."""
    if sys.argv[1:] == ["--version"]:  # answered at once: the command line's library takes a fifth of a second to load
        from monitor import __version__

        print(__version__)
        return
    from monitor.cli.app import main as run

    run()
