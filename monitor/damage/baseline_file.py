"""The baseline, of either kind, as a JSON file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

from monitor.core import (
    Array,
    BadConfigurationError,
    BadInputError,
    MissingInputError,
    decode,
    encode,
    write_atomically,
)
from monitor.damage.baseline import AnyBaseline, Baseline, ModalBaseline
from monitor.damage.covariates import read_law
from monitor.damage.origin import MODAL, Origin, number_differences, sensor_differences
from monitor.damage.record_scatter import RecordScatter
from monitor.damage.spectrum import read_spectrum
from monitor.damage.updating import UpdatingSettings
from monitor.model import InstrumentedModel, prior_file

FORMAT = 1
"""Counts changes of the file's meaning; files of another number are refused. [1; definition]"""
_BAD_CONTENT = (ValueError, KeyError, TypeError, OverflowError, RecursionError)
"""Errors of content that is no baseline's. [definition]"""
_OWN = ("model", "reference", "doubts")
"""Fields of a baseline that its file has in another form, or not at all. [names; definition]"""


_REMEDY = "name this structure's own baseline, or make it with 'calibrate'"
"""What to do where a baseline is another structure's. [words]"""

_OF_A_MODEL = "of a structure with a model, and here the modes alone are monitored"
"""Why a baseline is none of modes alone. [words]"""
_OF_MODES_ALONE = "of modes alone, and this structure has a model"
"""Why a baseline is none of a structure with a model. [words]"""

Built = TypeVar("Built", Baseline, ModalBaseline)


@dataclass(frozen=True, eq=False, slots=True)
class _Model:
    """Parameters of the updated model, from which the structure file's model becomes the baseline's."""

    stiffness_n_per_m: Annotated[Array, "p", 0.0]
    masses_kg: Annotated[Array, "b", 0.0]
    stiffness_correction_n_per_m: Annotated[Array, "n n"] | None
    """As known at calibration: one that a diagnosis added later is contained in `misfit` already."""


@dataclass(frozen=True, slots=True)
class _Drawn:
    """What tells whose a baseline is."""

    origin: Origin
    channels: tuple[str, ...]
    floors: tuple[int | str, ...]
    log: bool
    gauges: tuple[int, ...]


def save_baseline(baseline: AnyBaseline, path: Path) -> None:
    """Write the baseline as JSON, atomically."""
    if isinstance(baseline, ModalBaseline):
        content = {"kind": MODAL, "format": FORMAT, **encode(baseline, omit=("doubts",))}
    else:
        structure = baseline.model.structure
        model = _Model(structure.stiffness_n_per_m, structure.masses_kg, baseline.model.correction)
        prior = prior_file.prior_content(baseline.reference)
        content = {"format": FORMAT, **encode(model), **encode(baseline, omit=_OWN), "reference": prior}
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load_baseline(
    path: Path, instrumented: InstrumentedModel, updating: UpdatingSettings, *, redrawn: bool = False
) -> Baseline:
    """Read a baseline and check that it belongs to this structure; its `doubts` say why it may not, or is not to be trusted.

    Parameters
    ----------
    redrawn : bool
        Accept a changed drawing of the same structure, for `rebase_baseline`.

    Raises
    ------
    MissingInputError, BadInputError
        If the file cannot be read, or is no baseline or damaged.
    BadConfigurationError
        If the baseline is another structure's, or of another kind.
    """

    def build(tree: dict[str, Any]) -> Baseline:
        """Check and build the baseline."""
        _demand_own(path, tree, instrumented, updating, redrawn)
        return _build(tree, instrumented)

    loaded = _load(path, build, is_modal=False)
    there, here = loaded.origin, Origin.of(instrumented)
    doubts: tuple[str, ...] = ()
    if there.is_named_otherwise(here):
        doubts = (
            f"the baseline {path.name} is of {there.name!r}, and this is {here.name!r}, drawn alike: if it is the same "
            "structure, 'calibrate --rebase' notes the new name",
        )
    if not loaded.converged:
        doubts += (
            f"the updating of the baseline {path.name} did not converge: losses against it are not to be trusted; see what "
            "'calibrate' says",
        )
    return replace(loaded, doubts=doubts)


def load_modal_baseline(path: Path, channels: tuple[str, ...], here: Origin) -> ModalBaseline:
    """Read the healthy modes and check that they are of these channels and samples; errors as of `load_baseline`."""
    loaded = _load(path, _build_modal, is_modal=True)
    there = loaded.origin
    says = [] if loaded.channels == channels else [f"its channels are {', '.join(loaded.channels)}"]
    _refuse(path, says + there.sampling_differences(here), _REMEDY)
    if not there.is_named_otherwise(here):
        return loaded
    names = f"{there.name!r}, and this is {here.name!r}"
    doubt = f"the baseline {path.name} is of {names}: calibrate anew if that is another structure"
    return replace(loaded, doubts=(doubt,))


def _load(path: Path, build: Callable[[dict[str, Any]], Built], *, is_modal: bool) -> Built:
    """Read a file of one kind and build the baseline from its content; errors as of `load_baseline`."""
    try:
        tree = _read_content(path)
        if ("kind" in tree) != is_modal or tree.get("kind", MODAL) != MODAL:
            of_other = _OF_A_MODEL if is_modal else _OF_MODES_ALONE
            raise BadConfigurationError(
                f"{path}: the baseline is {of_other}; make one with 'calibrate' and this structure file"
            )
        if (written := tree["format"]) != FORMAT:
            raise BadInputError(f"{path}: baseline format {written!r}, expected {FORMAT}; calibrate anew")
        return build(tree)
    except _BAD_CONTENT as error:
        raise BadInputError(f"{path}: not a baseline file ({error}); make one with 'calibrate'") from error


def _read_content(path: Path) -> dict[str, Any]:
    """Read the JSON object that a baseline's file holds.

    MissingInputError or BadInputError if it cannot be read; ValueError, RecursionError or TypeError if it holds no such object.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a baseline file (no UTF-8 text); make one with 'calibrate'") from error
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror}") from error
    if path.suffix.casefold() == ".toml":
        raise BadInputError(
            f"{path}: a structure file, and no baseline: a baseline is the JSON file that 'calibrate --out' writes"
        )
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise TypeError("it is no JSON object")
    return tree


def _demand_own(
    path: Path, tree: dict[str, Any], instrumented: InstrumentedModel, updating: UpdatingSettings, redrawn: bool
) -> None:
    """Refuse a baseline of another structure, of other sensors or of other samples (BadConfigurationError).

    ValueError if the content is damaged.
    """
    told = decode(_Drawn, {f.name: tree[f.name] for f in fields(_Drawn)})
    here, there = Origin.of(instrumented), told.origin
    numbers = len(tree["masses_kg"]), len(tree["stiffness_n_per_m"])
    if (len(there.masses_kg), len(there.stiffness_n_per_m)) != numbers:
        raise ValueError("the numbers of masses and stiffnesses are not those of its origin")
    says = number_differences(*numbers, instrumented) + sensor_differences(told.channels, told.floors, instrumented)
    says += there.sampling_differences(here)
    if told.log != (updating.eigenvalue == "log") or bool(told.gauges) != updating.use_shapes:
        says.append("it was learned with another [updating] eigenvalue or use_shapes")
    mend = _REMEDY
    if not says and not redrawn:
        says = there.drawing_differences(here)
        mend += f"; if the structure is the same and only its drawing was changed, use 'calibrate --rebase {path}'"
    if says and there.is_named_otherwise(here):
        says.insert(0, f"it is of {there.name!r}, this is {here.name!r}")
    _refuse(path, says, mend)


def _refuse(path: Path, says: list[str], mend: str) -> None:
    """Refuse a baseline that differs from the structure (BadConfigurationError), with the differences in words and the remedy."""
    if says:
        raise BadConfigurationError(f"{path}: the baseline is not of this structure: {'; '.join(says)}. Remedy: {mend}")


def _read_scatter(content: Any, p: int) -> RecordScatter | None:
    """Read the scatter between records of p stories; ValueError if it is damaged."""
    return None if content is None else decode(RecordScatter, content, place="scatter", d=p)


def _build(tree: dict[str, Any], instrumented: InstrumentedModel) -> Baseline:
    """Build the baseline from a file's content; ValueError, KeyError or TypeError if its parts do not fit."""
    model, channels = instrumented.model, instrumented.channels
    n, p, m, c = model.structure.n_dofs, model.structure.n_stories, len(tree["model_mode"]), len(channels)
    b = model.structure.n_masses
    model_keys = [f.name for f in fields(_Model)]
    own = decode(_Model, {name: tree[name] for name in model_keys}, n=n, b=b, p=p)
    drawn = replace(model, correction=own.stiffness_correction_n_per_m)
    built = decode(
        Baseline,
        tree,
        {
            "model": drawn.with_stiffness(own.stiffness_n_per_m).with_masses(own.masses_kg),
            "law": read_law(tree["law"], p),
            "reference": prior_file.read_prior(tree["reference"], drawn, channels),
            "scatter": _read_scatter(tree["scatter"], p),
            "doubts": (),
        },
        beside=("format", *model_keys),
        theta=p + b,
        d=m + len(tree["gauges"]) * (c - 1),
        m=m,
        c=c,
    )
    modes = built.model_mode
    if (
        not all(0 <= i < n for i in modes)
        or len(set(modes)) != m
        or not all(0 <= g < c for g in built.gauges)
        or len(built.gauges) not in (0, m)
    ):
        raise ValueError("its modes are damaged")
    return built


def _build_modal(tree: dict[str, Any]) -> ModalBaseline:
    """Build the baseline from a file's content; ValueError, KeyError or TypeError if its parts do not fit each other."""
    m, c = len(tree["frequencies_hz"]), len(tree["channels"])
    laws = {"law": read_law(tree["law"], m), "shape_law": read_law(tree["shape_law"], m * (c - 1), "shape_law")}
    given = laws | {"doubts": (), "spectrum": read_spectrum(tree["spectrum"])}
    built = decode(ModalBaseline, tree, given, beside=("kind", "format"), d=m * c, m=m, c=c)
    if not m or len(built.gauges) != m or not all(0 <= g < c for g in built.gauges):
        raise ValueError("its gauges are damaged")
    if any(law is not None and law.common is not None for law in laws.values()):
        raise ValueError("what modes do together is not judged")
    return built
