"""The ledger of decisions: accept a finding, extend the structure file, and note who did it."""

from __future__ import annotations

import getpass
import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from monitor.config import Configuration
from monitor.core import BadInputError, MissingInputError, sha256
from monitor.diagnosis import effects_text, model_from_plain, structure_text
from monitor.model import FORMS, Effect, EffectError

LEDGER = "ledger.jsonl"


def read_finding(path: Path) -> dict[str, Any]:
    """Read a finding that may be accepted: diagnosis.json, or one of a replay's findings.

    Raises
    ------
    MissingInputError, BadInputError
        The latter also if no cause was named.
    """
    try:
        finding = json.loads(path.read_text(encoding="utf-8"))
        verdict, says = finding["verdict"], finding["says"]
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror}") from error
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
    """Write the structure file with the finding's causes.

    With a baseline, which brings the healthy stiffness and masses, the causes alone are added; without, the model that was
    fitted beside them is written too.

    Parameters
    ----------
    structure : str
        The structure file, `config` its settings.

    Raises
    ------
    BadInputError
        If the finding is not one of this structure.
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
    except (KeyError, TypeError, ValueError) as error:  # EffectError among them
        raise BadInputError(f"{path}: not a finding of this structure ({error})") from error


def _effect_of_cause(cause: Mapping[str, Any], config: Configuration) -> Effect:
    if cause["effect"] not in FORMS:
        raise EffectError(f"unknown effect {cause['effect']!r}")
    values = {name: float(p["value"]) for name, p in cause["parameters"].items()}
    effect = FORMS[cause["effect"]].create(cause["location"], values)
    effect.check(config.model().structure, config.channels)
    return effect


def append_entry(out: Path, finding: Mapping[str, Any], files: Mapping[str, Path | None], who: str | None) -> Path:
    """Append one line to the ledger beside `out`, and return the ledger's path.

    Parameters
    ----------
    files : mapping
        Files of the decision by role; the line names each with its checksum.

    Raises
    ------
    MissingInputError
        If the ledger cannot be written.
    """
    line = {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "who": who or _user(),
        "what": finding["says"],
        "causes": finding["causes"],
        "files": {role: {"file": str(p), "sha256": sha256(p)} for role, p in files.items() if p is not None},
    }
    ledger = out.resolve().parent / LEDGER
    try:
        with ledger.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise MissingInputError(f"{ledger}: cannot be written: {error.strerror}") from error
    return ledger


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"
