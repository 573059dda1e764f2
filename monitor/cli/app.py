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
from typing import Annotated, NoReturn

import typer
from typer.main import get_command

from monitor import __version__
from monitor.cli.analyse import calibrate, replay
from monitor.cli.check import check
from monitor.cli.common import leave_unread
from monitor.cli.compare import compare
from monitor.cli.demo import demo, reproduce
from monitor.cli.diagnose import accept, diagnose, evaluate
from monitor.cli.emulate import emulate
from monitor.cli.features import features
from monitor.cli.fleet import fleet
from monitor.cli.host import dataset, host
from monitor.cli.look import look
from monitor.cli.operate import ack, export, notify, status
from monitor.cli.recordings import import_, simulate
from monitor.cli.report import report
from monitor.cli.reprocess import reprocess
from monitor.cli.run import run, warm
from monitor.cli.view import view
from monitor.core import (
    BadConfigurationError,
    BadInputError,
    MissingInputError,
    NoResourcesError,
    UserError,
    keep_freed,
    single_blas_thread,
)

_COMMANDS = (
    diagnose,
    evaluate,
    accept,
    run,
    warm,
    host,
    dataset,
    emulate,
    report,
    status,
    ack,
    notify,
    export,
    reprocess,
    view,
    fleet,
    replay,
    calibrate,
    features,
    simulate,
    look,
    compare,
    import_,
    check,
    reproduce,
    demo,
)
"""Functions that are commands, in the order of the help."""

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich markup would swallow text in square brackets
    context_settings={"max_content_width": 120},
    help="Online structural health monitor: identification, model updating, damage index, alarms. SI units, UTC.",
)

for _command in _COMMANDS:
    app.command(_command.__name__.removesuffix("_"))(_command)


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
        _end(f"{kind}{error}", error)
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        remedy = "; run this as its owner or as root" if isinstance(error, PermissionError) else ""
        _end(f"{place}{error.strerror or error}{remedy}", MissingInputError)
    except (ArithmeticError, ValueError) as error:
        if not isinstance(error, ArithmeticError) and type(error).__name__ != "LinAlgError":
            raise
        remedy = "look at units, levels and channels with 'look'"
        _end(f"the numbers of these recordings cannot be solved ({error}): {remedy}", BadInputError)
    except MemoryError as error:
        _end(f"too little memory: {error}", NoResourcesError)


def _end(message: str, error: UserError | type[UserError]) -> NoReturn:
    """End with a message and the exit code of an error."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(error.exit_code) from None
