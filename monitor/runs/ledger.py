"""Ledger of decisions: accepts a finding, extends the structure file, and records who decided."""

from __future__ import annotations

import getpass
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from monitor.config import Configuration
from monitor.core import BadInputError, os_errors_of, sha256
from monitor.diagnosis import effects_text, model_from_plain, structure_text
from monitor.model import FORMS, Effect, EffectError
from monitor.runs.event_recordings import FOLDER
from monitor.runs.ledger_chain import append_lines

LEDGER = "ledger.jsonl"
_RECORDING = "recording"
"""Role of an event's recording among the files of a line. [name; definition]"""


def read_finding(path: Path) -> dict[str, Any]:
    """Read a finding that may be accepted: diagnosis.json, or one of a replay's findings.

    Raises MissingInputError if the file cannot be read, BadInputError if it is no finding or the finding names no cause.
    """
    try:
        with os_errors_of(path):
            finding = json.loads(path.read_text(encoding="utf-8"))
        verdict, says = finding["verdict"], finding["says"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInputError(
            f"{path}: not a finding ({error!r}); give a diagnosis.json or DIR/findings/ID.json"
        ) from error
    if verdict != "named":
        raise BadInputError(f"{path}: the verdict is {verdict!r}, so there is no cause to accept ({says})")
    return dict(finding)


def extended_structure_text(
    path: Path, finding: Mapping[str, Any], structure: str, config: Configuration, *, with_baseline: bool
) -> str:
    """Return the text of the structure file (text `structure`) extended by the causes of the finding in the file `path`.

    With a baseline, which contains the healthy stiffness and masses, only the causes are added.  Without a baseline, the
    model that was fitted together with the causes is written too.  Raises BadInputError if the finding does not belong to this
    structure.
    """
    if with_baseline and not finding.get("since_calibration"):
        raise BadInputError(f"{path}: this finding refers to the structure file; accept it without --baseline")
    try:
        causes = tuple(_effect_of_cause(c, config) for c in finding["causes"])
        if with_baseline:
            return effects_text(structure, (*config.model().effects, *causes))
        model = model_from_plain(finding["model"], config.model())
        for effect in model.effects:
            effect.check(model.structure, config.channels)
        return structure_text(structure, model, finding["model"]["reference_temperature_degc"])
    except (KeyError, TypeError, ValueError) as error:  # includes EffectError
        raise BadInputError(f"{path}: not a finding of this structure ({error})") from error


def _effect_of_cause(cause: Mapping[str, Any], config: Configuration) -> Effect:
    """Create the effect of a finding's cause; raise EffectError if it does not fit the structure."""
    if cause["effect"] not in FORMS:
        raise EffectError(f"unknown effect {cause['effect']!r}")
    values = {name: float(p["value"]) for name, p in cause["parameters"].items()}
    effect = FORMS[cause["effect"]].create(cause["location"], values)
    effect.check(config.model().structure, config.channels)
    return effect


def append_entry(out: Path, finding: Mapping[str, Any], files: Mapping[str, Path | None], who: str | None) -> Path:
    """Append one line to the ledger in the folder of `out`, the file that the decision wrote, and return the ledger's path.

    The line names the files of the decision by role, each with its checksum, and the person who decided, by default the user of
    the process.  Raises MissingInputError if the ledger cannot be written.
    """
    ledger = out.resolve().parent / LEDGER
    append_lines(ledger, [entry(finding, files, who)])
    return ledger


def entry(finding: Mapping[str, Any], files: Mapping[str, Path | None], who: str | None) -> dict[str, Any]:
    """Build the content of a line of the ledger (parameters as of `append_entry`), with the present time."""
    return {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "who": who or _user(),
        "what": finding["says"],
        "causes": finding["causes"],
        "files": {role: {"file": str(p), "sha256": sha256(p)} for role, p in files.items() if p is not None},
    }


def recording_entry(name: str, checksum: str) -> dict[str, Any]:
    """Build the content of the line of an event's recording, of which the name is relative to the ledger's folder."""
    line = entry({"says": f"{name} is written", "causes": []}, {}, None)
    return line | {"files": {_RECORDING: {"file": name, "sha256": checksum}}}


def verify_recordings(ledger: Path) -> int:
    """Compare each event's recording that is still there with its checksum in the ledger, and return their number.

    A recording that was written again, after a restart, has two lines, of which the later one counts.  Raises BadInputError
    if a recording was changed after it was written, MissingInputError if the ledger or a recording cannot be read.
    """
    known, found = dict[str, str](), 0
    with os_errors_of(ledger):
        rows = ledger.read_bytes().splitlines() if ledger.exists() else []
    for row in rows:
        with suppress(ValueError, KeyError, TypeError, RecursionError):  # a line of another kind
            recording = json.loads(row)["files"][_RECORDING]
            known[Path(recording["file"]).name] = str(recording["sha256"])
    for name, checksum in known.items():
        path = ledger.parent / FOLDER / name
        if not path.is_file():
            continue
        with os_errors_of(path):
            present = sha256(path)
        if present != checksum:
            raise BadInputError(
                f"{path}: its SHA-256 is not that of the ledger: it was changed after it was written; compare with a copy"
            )
        found += 1
    return found


def _user() -> str:
    """Return the name of the process's user, or the number of a user without a name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"
