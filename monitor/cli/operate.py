"""Commands by which operators inspect and control a running daemon: status, ack, notify, export."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from monitor.cli.common import Json, say, time_ns, warn
from monitor.cli.progress import progress
from monitor.core import BadConfigurationError, MissingInputError, WrongUsageError, spare_inputs

if TYPE_CHECKING:
    from monitor.config import Configuration
    from monitor.service import Request

_WAIT_S = 5.0
_APPLIED = "applied; what it changed is noted in ledger.jsonl"


def status(
    place: Annotated[Path, Argument(metavar="SITE.toml|DIR", help="Site file, or the daemon's output folder.")],
    verify: Annotated[
        bool, Option("--verify", help="Check ledger.jsonl and the event recordings that it names first; 65: changed.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Print the state of a structure and of its daemon in ten lines.

    Exit code 0: normal, and the daemon works; 10: advisory, warning or alarm; 11: doubtful, not judged, or the source, the
    recorder or an output does not work; 12: the daemon does not run, or is silent for a minute.
    """
    from monitor.service import status as reader

    folder = _folder(place)
    found = reader.look(folder) if place.is_dir() else reader.look(folder, str(place))
    text = reader.tell(found)
    if verify:
        found["ledger_lines"], unchanged = reader.verify_ledger(folder)
        text += f"\nledger    {found['ledger_lines']} lines, the chain is whole; head {found['ledger_head'] or 'none'}"
        if unchanged:
            text += f"; event recordings unchanged: {unchanged}"
    say(text, found, as_json)
    raise Exit(found["exit_code"])


def ack(
    file: Annotated[Path, Argument(metavar="SITE.toml", help="Site file of the running daemon.")],
    who: Annotated[str, Option(metavar="NAME", help="Name of who decides; recorded in the ledger.")],
    story: Annotated[
        int | None, Option(min=0, metavar="N", help="Story; 0: the structure as a whole.", show_default=False)
    ] = None,
    event: Annotated[str | None, Option(metavar="ID", help="Event that exceeded a limit, in place of a story.")] = None,
    note: Annotated[str, Option(help="Reason; shelving needs one.")] = "",
    shelve: Annotated[
        float | None, Option(min=0.0, max=720.0, metavar="HOURS", help="Do not announce the alarm for this time.")
    ] = None,
    unshelve: Annotated[bool, Option("--unshelve", help="Announce the alarm again.")] = False,
    reset: Annotated[bool, Option("--reset", help="Release a latched alarm that is over and acknowledged.")] = False,
    as_json: Json = False,
) -> None:
    """Acknowledge the alarm of a story or event, shelve or reset it.

    The request goes over Zenoh if the site file has [output.zenoh] and the daemon answers there.  Otherwise it goes through
    the daemon's folder, to which the user needs write access.
    """
    from pydantic import ValidationError

    from monitor.config import configuration
    from monitor.core import settings_problems
    from monitor.service import Request

    settings = configuration.load(file)
    stories = len(settings.story_names)
    if (story is None) == (event is None):
        raise WrongUsageError("give --story N or --event ID, as 'status' lists them")
    if settings.has_model and story is not None and story > stories:
        raise WrongUsageError(f"--story {story}: {file} has {stories}, and 0 for the whole")
    if sum((shelve is not None, unshelve, reset)) > 1:
        raise WrongUsageError("--shelve, --unshelve and --reset exclude each other")
    action = "shelve" if shelve is not None else "unshelve" if unshelve else "reset" if reset else "acknowledge"
    seconds = 3600.0 * (shelve or 0.0)
    fields = {"action": action, "story": story, "event": event, "who": who, "note": note, "seconds": seconds}
    try:
        request = Request.model_validate(fields)
    except ValidationError as error:
        raise WrongUsageError("; ".join(settings_problems(error))) from error
    applied, outcome = False, ""
    if settings.output.zenoh is not None:
        applied = _send_over_zenoh(file, settings, request.model_dump_json())
        outcome = _APPLIED
    if not applied:
        applied, outcome = _send_by_file(file.resolve().parent / settings.output.dir, request)
    say(outcome, {"applied": applied, "says": outcome}, as_json)


def notify(
    file: Annotated[Path, Argument(metavar="SITE.toml", help="Site file with a table [notify].")],
    test: Annotated[bool, Option("--test", help="Send a test message to every address.")] = False,
    as_json: Json = False,
) -> None:
    """Send a test message to every address of [notify].

    Heartbeats are sent too; what became of each is printed.

    Exit code 0: all have taken it; 1: one has not.  The exit code of each delivery is printed too: 0 taken, 1 refused or not
    reached, negative: ended after 30 s without an answer.
    """
    from monitor.config import configuration
    from monitor.service import outlets

    if not test:
        raise WrongUsageError("give --test: the daemon itself sends all other messages")
    trials = outlets.send_test_messages(file, configuration.load(file))
    code = 0 if all(trial.exit_code == 0 for trial in trials) else 1
    content = [{"address": t.name, "exit_code": t.exit_code, "took_s": t.took_s, "says": t.says} for t in trials]
    lines = [f"{t.name}: {t.says} (exit code {t.exit_code})" for t in trials]
    if any(t.exit_code != 0 and t.name.startswith("address") for t in trials):
        lines.append("why, says the program that sends them: apprise -vv --title test --body test 'URL'")
    say("\n".join(lines), {"exit_code": code, "addresses": content}, as_json)
    raise Exit(code)


def export(
    place: Annotated[
        Path, Argument(metavar="SITE.toml|DIR", help="Site file, or the folder that run or replay wrote.")
    ],
    out: Annotated[Path, Option(metavar="FILE", help="File to write; it appears when it is complete.")],
    table: Annotated[
        str | None,
        Option(
            help="windows, modes (with their shapes), alarms; of a daemon also requests (acknowledgements), findings, gaps or "
            "health. By default windows, for UFF modes."
        ),
    ] = None,
    form: Annotated[
        str | None,
        Option(
            "--format",
            help="csv, parquet, uff (modes as datasets 55 and 58) or influx (line protocol); by default told by the suffix: "
            ".csv, .parquet, .uff or .unv, .lp.",
        ),
    ] = None,
    structure: Annotated[
        Path | None,
        Option(
            metavar="S.toml",
            help="Structure file, for the names of the channels in mode shapes; by default those of the run.",
        ),
    ] = None,
    begin: Annotated[str | None, Option("--from", metavar="TIME", help="ISO 8601, UTC; included.")] = None,
    end: Annotated[str | None, Option("--to", metavar="TIME", help="ISO 8601, UTC; not included.")] = None,
    as_json: Json = False,
) -> None:
    """Export the results of a run as a table.  SI units, times in UTC as ns since 1970; a running daemon is not disturbed."""
    from monitor.config import configuration
    from monitor.service import export as writer

    spare_inputs([out], [place, structure])
    until_ns = time_ns("--to", end)
    span = time_ns("--from", begin) or 0, (1 << 63) - 1 if until_ns is None else until_ns
    form = writer.form_of(out, form)
    table = table or ("modes" if form == "uff" else "windows")
    named, folder = structure or (None if place.is_dir() else place), _folder(place)
    channels = configuration.load(named).channels if named is not None else writer.channels_of(folder)
    with progress("export", f"writes {table}"):
        rows = writer.export(folder, table, out, span, form=form, channels=channels)
    what = f"{rows} modes" if form == "uff" else f"{rows} rows of {table}"
    say(f"{what} in {out}", {"rows": rows, "table": table, "format": form, "out": str(out)}, as_json)


def _folder(place: Path) -> Path:
    """Return the daemon's output folder, named itself or by its site file."""
    from monitor.config import configuration

    return place if place.is_dir() else place.resolve().parent / configuration.load(place).output.dir


def _send_over_zenoh(file: Path, settings: Configuration, request: str) -> bool:
    """Send a request over Zenoh; return whether the daemon applied it, False if none answers."""
    from pydantic import ValidationError

    from drivers.base import SourceError
    from monitor.core import read_settings, settings_problems
    from monitor.service import ZenohOutSettings, ask, key_prefix

    try:
        joining = read_settings(ZenohOutSettings, settings.output.zenoh or {})
    except ValidationError as error:
        problems = settings_problems(error, "output", "zenoh")
        raise BadConfigurationError("\n".join(f"{file}: {problem}" for problem in problems)) from error
    try:
        answer = ask(joining, file.resolve().parent, key_prefix(settings.site_name, joining), request, _WAIT_S)
    except SourceError as error:
        warn(f"{error}; leaving the request in the daemon's folder")
        return False
    if answer is None:
        warn("nobody answers over Zenoh; leaving the request in the daemon's folder")
        return False
    if not answer.get("accepted"):
        raise WrongUsageError(f"refused: {answer.get('reason')}")
    return True


def _send_by_file(out: Path, request: Request) -> tuple[bool, str]:
    """Leave a request in the daemon's folder; return whether the daemon has applied it by now, and that in words."""
    from monitor.service import leave_request, status as reader, take_refusal

    reader.demand_state(out)
    try:
        place = leave_request(out / "state" / "requests", request)
    except OSError as error:
        raise MissingInputError(f"{out / 'state' / 'requests'}: cannot be written: {error.strerror}") from error
    deadline = time.monotonic() + _WAIT_S
    while place.exists() and reader.running(out) and time.monotonic() < deadline:
        time.sleep(0.1)
    if not place.exists():
        refusal = take_refusal(place)
        if refusal is not None:
            raise WrongUsageError(f"refused: {refusal}")
        return True, _APPLIED
    if not reader.running(out):
        return False, "the daemon does not run; it is applied with the first data of its next run"
    return False, "left for the daemon, which applies it when data come and ledger.jsonl can be written: ask 'status'"
