"""Application that collects the commands; `monitor.core.errors` defines their exit codes, README.md and docs/ explain them.

A module of commands imports what its commands need inside their functions.  So the list of commands, and the start of any
one command, load nothing that the others need.
"""

from __future__ import annotations

import functools
import logging
import os
import sys
import threading
from collections.abc import Callable
from typing import Annotated

import typer
from typer.main import get_command

from monitor import __version__
from monitor.cli import (
    analyse,
    check,
    compare,
    demo,
    diagnose,
    emulate,
    features,
    fleet,
    host,
    look,
    operate,
    recordings,
    report,
    reprocess,
    run,
    view,
)
from monitor.cli.common import leave_unread
from monitor.core import (
    BadConfigurationError,
    BadInputError,
    MissingInputError,
    NoResourcesError,
    UserError,
    keep_freed,
    single_blas_thread,
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich markup would swallow text in square brackets
    context_settings={"max_content_width": 120},
    help="Online structural health monitor: identification, model updating, damage index, alarms. SI units, UTC.",
)

for command in (
    diagnose.diagnose,
    diagnose.evaluate,
    diagnose.accept,
    run.run,
    run.warm,
    host.host,
    host.dataset,
    emulate.emulate,
    report.report,
    operate.status,
    operate.ack,
    operate.notify,
    operate.export,
    reprocess.reprocess,
    view.view,
    fleet.fleet,
    analyse.replay,
    analyse.calibrate,
    features.features,
    recordings.simulate,
    look.look,
    compare.compare,
):
    app.command()(command)
app.command("import")(recordings.import_)
app.command()(check.check)
app.command()(demo.reproduce)
app.command()(demo.demo)


@app.callback(invoke_without_command=True)
def _main(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        print(__version__)
        raise typer.Exit


def main() -> None:
    """Run the command line; report an error of the user as one message and its exit code."""
    try:
        call()
    except SystemExit as end:
        if any(thread.daemon for thread in threading.enumerate()) and isinstance(end.code, int):
            # A thread that still waits for a disk or a network aborts the process if it returns while the interpreter ends.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(end.code)
        raise


@functools.cache
def command_line() -> Callable[[], object]:
    """Build the commands from their functions, which takes longer than most of them need to answer."""
    leave_unread(app)
    return get_command(app)


def call() -> None:
    """Call the command that the arguments name; always raises SystemExit, except after an unexpected error."""
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", level=logging.WARNING)
    keep_freed()
    try:
        with single_blas_thread():
            command_line()()
    except UserError as error:
        kind = "bad configuration\n" if isinstance(error, BadConfigurationError) else ""
        print(f"error: {kind}{error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        remedy = "; run this as its owner or as root" if isinstance(error, PermissionError) else ""
        print(f"error: {place}{error.strerror or error}{remedy}", file=sys.stderr)
        raise SystemExit(MissingInputError.exit_code) from None
    except (ArithmeticError, ValueError) as error:
        if not isinstance(error, ArithmeticError) and type(error).__name__ != "LinAlgError":
            raise
        print(
            f"error: the numbers of these recordings cannot be solved ({error}): look at units, levels and channels with "
            "'look'",
            file=sys.stderr,
        )
        raise SystemExit(BadInputError.exit_code) from None
    except MemoryError as error:
        print(f"error: too little memory: {error}", file=sys.stderr)
        raise SystemExit(NoResourcesError.exit_code) from None
