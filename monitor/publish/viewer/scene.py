"""Description of a site for the viewer, the text of its estimates and its colours; pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np

from drivers.base import ClockHealth
from monitor.config import Configuration
from monitor.core import DIRECTION_WORDS, Array, ModalEstimate, WindowResult, storey_of, utc
from monitor.damage import AnyBaseline, Baseline, Features, LearnedRange, ModalBaseline, learned_ranges
from monitor.model import Drawing, Model

Colour = tuple[int, int, int]

GREEN, AMBER, RED, GREY = (80, 190, 110), (240, 180, 50), (230, 70, 60), (130, 130, 130)
SERIES: tuple[Colour, ...] = (
    (90, 170, 250), (250, 170, 70), (190, 130, 240), (90, 210, 190), (240, 120, 160), (220, 220, 90),
    (120, 200, 90), (170, 190, 220), (200, 140, 90), (110, 120, 250), (240, 90, 90), (160, 220, 240),
)  # fmt: skip
"""Colours of lines: of stories, of modes and of channels."""
LIVE_BLOCK_S, FILE_BLOCK_S = 1.0, 60.0
"""Shortest length of the blocks in which samples are sent, s, and number of results that are sent at a time.

Both are small for viewers that watch, and large for a small file that is written fast.
"""
_MODE_GAP = 0.4
"""Free space between drawn mode shapes, over the size of the structure. [ratio; judgement]"""
_DEPTH_GAP = 0.25
"""What is added for what stands behind, which is seen nearer to the middle, over the depth. [ratio; measured on pictures]"""
_MARGIN = 0.2
"""Free space at the right of the last mode shape's rest, over the size of the structure. [ratio; measured on pictures]"""
_LONG = 0.5
"""Height over length below which a structure is long. [ratio; judgement]"""
_LABEL_STEP = 0.09
"""Distance of two labels, over the size of the structure. [ratio; judgement]"""
_LABEL_SHARE = 0.33
"""Share of the view's width that the labels at the left take. [ratio; measured on pictures]"""
_IN_A_ROW = 4
"""Mode shapes beside each other where they have a view of their own. [count; judgement: legible in half a window]"""
_LABEL_ROWS = 3
"""Rows over which the labels of a long structure are spread. [count; judgement]"""
STABILISATION = (100.0, 55.0)
"""Width and height of the canvas of the stabilisation diagram."""


def _pitch(size: Array, *, is_long: bool) -> float:
    """Compute the distance of neighbouring mode shapes."""
    return float(size[2] + _MODE_GAP if is_long else size[0] + _MODE_GAP + _DEPTH_GAP * size[1])


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Places in the view of a structure: it is drawn 1 large, its mode shapes beside it, or below it if it is long."""

    points: Annotated[Array, "n 3"]
    labels: Annotated[Array, "p 3"]
    """Place of the label of every story."""
    size: Annotated[Array, "3"]
    """Extent of the structure along x, y and z."""
    is_long: bool
    low: Annotated[Array, "3"]
    """Lower corner of structure, labels and mode shapes."""
    high: Annotated[Array, "3"]
    """Their upper corner."""
    apart: tuple[Array, Array] | None = None
    """Corners of the mode shapes, where they have a view of their own, as of a building."""
    is_crowded: bool = False
    """Whether there is room for the labels of those stories only that changed."""

    @classmethod
    def of(cls, drawing: Drawing, n_stories: int, n_modes: int) -> Plan:
        """Plan the view of a drawing: labels in a column at its left, or in rows above a long one; none without stories."""
        if drawing.beside:
            return cls._of_elevations(drawing, n_stories, n_modes)
        low, high = drawing.points.min(axis=0), drawing.points.max(axis=0)
        scale = max(float((high - low).max()), 1e-12)
        points, size = (drawing.points - low) / scale, (high - low) / scale
        is_long = bool(size[2] < _LONG * size[0])
        ends = [points[drawing.lines[drawing.stories == j]].reshape(-1, 3) for j in range(n_stories)]
        labels = np.array([e.mean(axis=0) for e in ends]).reshape(-1, 3)
        length = n_modes * _pitch(size, is_long=is_long)  # of the mode shapes
        if is_long:
            labels[:, 2] = size[2] + _LABEL_STEP * (1 + np.arange(n_stories) % _LABEL_ROWS)
            low, high = (-0.4, 0.0, -length - 0.15), (1.15, 0.0, size[2] + _LABEL_STEP * (1 + _LABEL_ROWS))
        else:
            share = _LABEL_SHARE if n_stories else 0.0
            room = share / (1.0 - share) * (size[0] + length + _MARGIN)
            labels[:, 0] = -0.5 * room - 0.05
            step = _LABEL_STEP * max(1.0, 1.3 * room)
            for above, j in pairwise(np.argsort(-labels[:, 2], kind="stable")):
                labels[j, 2] = min(labels[j, 2], labels[above, 2] - step)
            low, high = (
                (-room - 0.1, 0.0, -0.15),
                (size[0] + length + _MARGIN, 0.0, size[2] + (0.05 if n_stories else 0.2)),
            )
        return cls(points, labels, size, is_long, np.array(low), np.array(high), is_crowded=is_long)

    @classmethod
    def _of_elevations(cls, drawing: Drawing, n_stories: int, n_modes: int) -> Plan:
        """Plan the view of a building, with a label in each storey of its elevations."""
        body, beside = (drawing.points[lines] for lines in np.split(drawing.lines, [-drawing.beside]))
        low, high = body.min(axis=(0, 1)), body.max(axis=(0, 1))
        points, size = (drawing.points - low) / (high - low).max(), (high - low) / (high - low).max()
        of = drawing.stories[-drawing.beside :]
        cells = [beside[of == j].reshape(-1, 3) for j in range(n_stories)]
        labels = np.array([(*c.mean(axis=0)[:2], c[:, 2].max()) for c in cells]).reshape(-1, 3)
        labels = (labels - low) / (high - low).max()
        room, rows = np.array([_MARGIN, 0.0, _MARGIN]), -(-n_modes // _IN_A_ROW)
        wide = min(n_modes, _IN_A_ROW) * _pitch(size, is_long=False)
        modes = np.array([0.0, 0.0, -rows * _pitch(size, is_long=True)]) - room, np.array([wide, 0.0, 0.0])
        crowded = sum(map(bool, drawing.names)) < len({*labels[:, 0].tolist()}) + len({*labels[:, 2].tolist()})
        box = points.min(axis=0) - 0.6 * room, points.max(axis=0) + room * (1.0, 0.0, 0.0)
        return cls(points, labels, size, False, *box, modes, crowded)

    def offset(self, mode: int) -> Annotated[Array, "3"]:
        """Compute the place of a mode shape relative to the structure."""
        if self.apart is not None:
            row, column = divmod(mode, _IN_A_ROW)
            return np.array(
                [column * _pitch(self.size, is_long=False), 0.0, -(row + 1) * _pitch(self.size, is_long=True)]
            )
        axis = np.array([0.0, 0.0, -1.0] if self.is_long else [1.0, 0.0, 0.0])
        return (mode + 1) * axis * _pitch(self.size, is_long=self.is_long)

    def mode_label(self, mode: int) -> tuple[float, float, float]:
        """Compute the place of a mode's label: below it, or at the left of a long structure."""
        own = (-0.2, 0.0, 0.5 * self.size[2]) if self.is_long else (0.5 * self.size[0], 0.0, -0.1)
        x, y, z = (self.offset(mode) + own).tolist()
        return x, y, z


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """Description of a site for the viewer."""

    name: str
    channels: tuple[str, ...]
    sensors: Annotated[Array, "c N"]
    """What each channel sees of the degrees of freedom."""
    drawing: Drawing
    story_names: tuple[str, ...]
    baseline_frequencies_hz: Annotated[Array, "m"] | None
    """Mode 0 is the model's lowest; NaN where the baseline lacks a mode."""
    has_baseline: bool
    alarm_loss: float
    """Relative stiffness loss that counts as an alarm."""
    model: Model | None = None
    """Model that predicts spectra; no spectra are predicted without one."""
    cutoff_hz: float = 40.0
    """Highest frequency of the analysis."""
    misfit_threshold: float = 5.0
    """Goodness of fit from which a diagnosis is requested."""
    n_modes: int = 3
    """Number of the model's modes, the lowest ones, that are shown."""
    learned: Mapping[str, LearnedRange] = field(default_factory=dict)
    """Range of each covariate at calibration."""
    features: Features | None = None
    """The features that are judged in place of a structure."""

    @property
    def n_stories(self) -> int:
        """Number of stories."""
        return len(self.story_names)

    @property
    def series(self) -> list[tuple[str, str, int]]:
        """Direction in words, name and number of each story where it is one of the curves of its direction."""
        places = map(storey_of, self.story_names)
        return [
            ("", name, j) if place is None else (DIRECTION_WORDS[place[1]], f"storey {place[0]}", place[0] - 1)
            for j, (name, place) in enumerate(zip(self.story_names, places, strict=True))
        ]

    @property
    def plan(self) -> Plan:
        """Places of structure, labels and mode shapes."""
        moves = bool((self.drawing.dofs >= 0).any())
        return Plan.of(self.drawing, self.n_stories, self.n_modes if moves else 0)


class Clocks(NamedTuple):
    """State of the sensor nodes' clocks at a time."""

    t_ns: int
    clocks: Sequence[ClockHealth]


def feature_scene(name: str, features: Features, learned: Mapping[str, LearnedRange]) -> Scene:
    """Describe features without waveforms to the viewer: there is no structure to be seen."""
    none = np.zeros((0, 2), dtype=np.intp)
    return Scene(
        name=name,
        channels=(),
        sensors=np.zeros((0, 0)),
        drawing=Drawing(np.zeros((1, 3)), np.full((1, 3), -1), none, none[:, 0]),
        story_names=(),
        baseline_frequencies_hz=None,
        has_baseline=True,
        alarm_loss=1.0,
        n_modes=0,
        learned=learned,
        features=features,
    )


def make_scene(config: Configuration, baseline: AnyBaseline | None) -> Scene:
    """Describe a site to the viewer; the baseline's model, if there is one, replaces that of the structure file.

    Without a model each channel is a degree of freedom of the drawing.
    """
    scene = Scene(
        name=config.site.name or config.structure.name or "structure",
        channels=config.channels,
        sensors=np.eye(len(config.channels)),
        drawing=config.drawing,
        story_names=(),
        baseline_frequencies_hz=None,
        has_baseline=baseline is not None,
        alarm_loss=config.alarm.alarm_loss,
        cutoff_hz=config.processing.cutoff_hz,
        n_modes=config.selection.max_modes,
        learned=learned_ranges(None if baseline is None else baseline.law),
    )
    if isinstance(baseline, ModalBaseline):
        return replace(scene, baseline_frequencies_hz=baseline.frequencies_hz, n_modes=baseline.frequencies_hz.size)
    if not config.has_model:
        assert baseline is None  # a model's baseline belongs to a structure with a model
        return scene
    site = config.instrumented()
    model = site.model
    below = int((model.modes().frequencies_hz <= scene.cutoff_hz).sum())
    return replace(
        scene,
        channels=site.channels,
        sensors=site.sensor_matrix,
        story_names=config.story_names,
        baseline_frequencies_hz=None if baseline is None else _by_model_mode(baseline),
        model=model if baseline is None else baseline.model,
        misfit_threshold=config.watch.misfit,
        n_modes=max(1, min(below, scene.n_modes)),
    )


def _by_model_mode(baseline: Baseline) -> Array:
    """Order the baseline's frequencies by number of the model's mode."""
    out = np.full(max(baseline.model_mode, default=-1) + 1, np.nan)
    out[list(baseline.model_mode)] = baseline.frequencies_hz
    return out


def loss_colour(loss: float | None, alarm_loss: float) -> Colour:
    """Choose the colour of a story: green, amber at half of `alarm_loss`, red from there on; grey when unknown."""
    if loss is None:
        return GREY
    x = min(max(2.0 * loss / alarm_loss, 0.0), 2.0)
    first, last, share = (GREEN, AMBER, x) if x < 1.0 else (AMBER, RED, x - 1.0)
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, last, strict=True))
    return red, green, blue


def plus_minus(value: float, std: float, scale: float = 1.0, digits: int = 1) -> str:
    """Write a value with two standard deviations."""
    return f"{value * scale:.{digits}f} ± {2 * std * scale:.{digits}f}"


def status_markdown(scene: Scene, result: WindowResult) -> str:
    """Describe the estimates of a window in Markdown; intervals are two standard deviations."""
    modes, damage, lines = result.modes, result.damage, []
    if result.skipped is not None:
        lines += [f"**No result for this window:** {result.skipped.reason}", ""]
    if damage is not None:
        since = f"since the baseline, alarm from {100 * scene.alarm_loss:g} %"
        lines += [f"Stiffness lost {since if scene.has_baseline else 'against the structure file (no baseline)'}", ""]
        rows = zip(scene.story_names, damage.ddi, damage.ddi_std, strict=True)
        losses = [(name.removeprefix("story "), plus_minus(d, s, 100)) for name, d, s in rows]
        lines += [*markdown_table(("story", "loss, % (± 2σ)"), losses), ""]
    if modes is not None:
        changes, table = dict(enumerate(_modal_changes(result))), []
        for k, f, fs, d, ds in mode_rows(modes):
            base = scene.baseline_frequencies_hz
            was = f"{base[k]:.3f}" if base is not None and k < len(base) and base[k] > 0 else "-"
            table.append((f"{k + 1}", plus_minus(f, fs, digits=3), was, plus_minus(d, ds, 100, 2), changes.get(k, "")))
        which = "not of the model" if scene.n_stories else "another one"
        for other in modes.others:
            f, fs, d = other.frequency_hz, other.frequency_std_hz, other.damping_ratio
            table.append((which, plus_minus(f, fs, digits=3), "-", f"{100 * d:.2f}", "-"))
        head = ("mode", "frequency, Hz (± 2σ)", "baseline, Hz", "damping, % (± 2σ)", "change, % (± 2σ)")
        shown = len(head) if changes else len(head) - 1
        lines += markdown_table(head[:shown], [row[:shown] for row in table])
    if scene.features is not None and result.features is not None and result.skipped is None:
        sizes = zip(result.features.change.tolist(), result.features.change_std.tolist(), strict=True)
        told = [
            (scene.features.name(k), scene.features.size(k, change, std) if np.isfinite(change) else "-")
            for k, (change, std) in enumerate(sizes, 1)
        ]
        lines += markdown_table(("feature", "change, less what covariates explain (± 2σ)"), told)
    length = f"window of {result.window_s:g} s to" if result.window_s else "reading of"
    lines += ["", f"{scene.name}, {length} {utc(result.t_end_ns, seconds=True)} UTC"]
    return "\n".join(lines)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Write the lines of a table in Markdown."""
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows)]


def _modal_changes(result: WindowResult) -> list[str]:
    """Write the change of each mode's frequency since the baseline; empty where a model is judged."""
    if result.modal is None:
        return []
    change = np.expm1(result.modal.ln_frequency).tolist()
    return [
        plus_minus(c, s, 100, 2) if np.isfinite(c) else "-"
        for c, s in zip(change, result.modal.ln_frequency_std.tolist(), strict=True)
    ]


def mode_rows(modes: ModalEstimate) -> list[tuple[int, float, float, float, float]]:
    """List number, frequency and its standard deviation (Hz), damping ratio and its standard deviation of each mode.

    The number is that of the model's mode.
    """
    columns = (modes.frequencies_hz, modes.frequencies_std_hz, modes.damping_ratio, modes.damping_std)
    table = np.column_stack(columns).tolist()
    return [(int(k), f, fs, d, ds) for k, (f, fs, d, ds) in zip(modes.model_mode, table, strict=True)]


NO_VALUE = (np.nan,) * 3
"""Interruption of a line and its bounds: without a row the line is bridged, and a Clear or an empty row drags the axis to 0."""
