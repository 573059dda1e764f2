"""The commands; `monitor.core.errors` has their exit codes, README.md and docs/ what they are for.

A module of commands imports what its work needs within its functions, so that every command is listed, and any one
begins, without the rest being loaded.
"""

from __future__ import annotations

import logging
import sys
from typing import Annotated

import typer

from monitor import __version__
from monitor.cli import (
    analyse,
    check,
    demo,
    diagnose,
    emulate,
    fleet,
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
    MissingInputError,
    NoResourcesError,
    UserError,
    keep_freed,
    single_blas_thread,
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # it would take what stands in square brackets for its own
    context_settings={"max_content_width": 120},
    help="Online structural health monitor: identification, model updating, damage index, alarms. SI units, UTC.",
)

for command in (
    diagnose.diagnose,
    diagnose.evaluate,
    diagnose.accept,
    run.run,
    emulate.emulate,
    report.report,
    operate.status,
    operate.ack,
    operate.export,
    reprocess.reprocess,
    view.view,
    fleet.fleet,
    analyse.replay,
    analyse.calibrate,
    recordings.simulate,
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
    """Entry point: user errors become one message and the contract's exit code."""
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s", level=logging.WARNING)
    keep_freed()
    leave_unread(app)
    try:
        with single_blas_thread():
            app()
    except UserError as error:
        kind = "bad configuration\n" if isinstance(error, BadConfigurationError) else ""
        print(f"error: {kind}{error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        mend = "; run this as its owner or as root" if isinstance(error, PermissionError) else ""
        print(f"error: {place}{error.strerror or error}{mend}", file=sys.stderr)
        raise SystemExit(MissingInputError.exit_code) from None
    except MemoryError as error:
        print(f"error: too little memory: {error}", file=sys.stderr)
        raise SystemExit(NoResourcesError.exit_code) from None
