"""The command line: one module a group of commands."""


def main() -> None:
    """Run the command that the command line names."""
    from monitor.cli.app import main as run

    run()
