"""The healthy modes as a JSON file, and the choice between the kinds of baseline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from monitor.core import BadConfigurationError, BadInputError, decode, encode
from monitor.damage.baseline_file import BAD_CONTENT, read_content, write_content
from monitor.damage.covariates import read_law
from monitor.damage.modal_baseline import ModalBaseline, ModalOrigin

MODAL_FORMAT = 1
"""Counts changes of the meaning of a file of modes; files of another number are refused. [1; definition]"""
MODAL = "modal"
"""Kind of the baseline in a file of modes. [name; definition]"""


def save_modal_baseline(baseline: ModalBaseline, path: Path) -> None:
    """Write the healthy modes as JSON, atomically."""
    write_content(path, {"kind": MODAL, "format": MODAL_FORMAT, **encode(baseline, omit=("doubts",))})


def load_modal_baseline(path: Path, channels: tuple[str, ...], here: ModalOrigin) -> ModalBaseline:
    """Read the healthy modes and check that they are of these channels and samples.

    Raises
    ------
    MissingInputError
        If the file cannot be read.
    BadInputError
        If the file is no baseline or damaged.
    BadConfigurationError
        If the baseline is another structure's, or of another kind.
    """
    try:
        tree = read_content(path)
        if tree.get("kind") != MODAL:
            raise BadConfigurationError(
                f"{path}: the baseline is of a structure with a model, and here the modes alone are monitored; make one with "
                "'calibrate' and this structure file"
            )
        if tree["format"] != MODAL_FORMAT:
            raise BadInputError(f"{path}: baseline format {tree['format']!r}, expected {MODAL_FORMAT}; calibrate anew")
        loaded = _build(tree)
    except BAD_CONTENT as error:
        raise BadInputError(f"{path}: not a baseline file ({error}); make one with 'calibrate'") from error
    there = loaded.origin
    says = [] if loaded.channels == channels else [f"its channels are {', '.join(loaded.channels)}"]
    says += [
        f"{what} is {a} there and {b} here"
        for what, a, b in (
            ("rate_hz", there.rate_hz, here.rate_hz),
            ("cutoff_hz", there.cutoff_hz, here.cutoff_hz),
            ("the unit", there.unit, here.unit),
        )
        if a != b
    ]
    if says:
        raise BadConfigurationError(
            f"{path}: the baseline is not of this structure: {'; '.join(says)}. Remedy: name this structure's own baseline, or "
            "make it with 'calibrate'"
        )
    if there.name and here.name and there.name != here.name:
        names = f"{there.name!r}, and this is {here.name!r}"
        return replace(
            loaded, doubts=(f"the baseline {path.name} is of {names}: calibrate anew if that is another structure",)
        )
    return loaded


def _build(tree: dict[str, Any]) -> ModalBaseline:
    """Build the baseline from a file's content.

    Raises
    ------
    ValueError, TypeError, KeyError
        If the parts of the content do not fit each other.
    """
    m, c = len(tree["frequencies_hz"]), len(tree["channels"])
    laws = {"law": read_law(tree["law"], m), "shape_law": read_law(tree["shape_law"], m * (c - 1), "shape_law")}
    built = decode(ModalBaseline, tree, laws | {"doubts": ()}, beside=("kind", "format"), m=m, c=c)
    if not m or len(built.gauges) != m or not all(0 <= g < c for g in built.gauges):
        raise ValueError("its gauges are damaged")
    return built
