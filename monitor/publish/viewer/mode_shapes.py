"""Drawing of the mode shapes beside the structure: still on the timeline ``time``, moving on the timeline ``phase``."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, ModalEstimate
from monitor.publish.viewer.rows import Rows, Strips
from monitor.publish.viewer.scene import GREY, SERIES, Scene

Colours = NDArray[np.uint8]
"""Colours of the modes, shape (.., 3)."""

_FRAMES = 24
"""Number of steps of the animation."""
_DEFLECTION = 0.15
"""Largest deflection of a drawn mode shape, over the size of the structure. [ratio; judgement]"""


def label(rows: Rows, path: str, places: list[tuple[float, float, float]], labels: list[str], colours: Colours) -> None:
    """Draw texts at places."""
    rows.add(path, rr.Points3D, positions=places, labels=labels, colors=colours, radii=[0.0001], show_labels=[True])


def expand_shape(
    shape: Annotated[ComplexArray, "c"], model_shape: Annotated[Array, "n"], sensors: Annotated[Array, "c n"]
) -> Annotated[ComplexArray, "n"]:
    """Expand a measured mode shape to all degrees of freedom by the model's shape, which is fitted to the sensors.

    The measured shape is NaN at a channel that is left out; `sensors` is what each sees of the degrees of freedom.

    Examples
    --------
    >>> expand_shape(np.array([2.0 + 0j]), np.array([1.0, 0.5]), np.array([[1.0, 0.0]])).real.tolist()
    [2.0, 1.0]
    """
    known = np.isfinite(shape)
    shape, sensors = shape[known], sensors[known]
    at_sensors = sensors @ model_shape
    size = float(at_sensors @ at_sensors)
    out = model_shape * ((at_sensors @ shape) / size if size > 0.0 else 0.0 + 0.0j)
    return np.asarray(out + np.linalg.pinv(sensors) @ (shape - sensors @ out))


class ModeShapes:
    """Drawing of the mode shapes into one recording, in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, to: Rows) -> None:
        self._scene, self._stream, self._to, self._plan = scene, stream, to, scene.plan
        dofs = scene.drawing.dofs
        self._n_dofs = max(int(dofs.max(initial=-1)) + 1, scene.sensors.shape[1])
        self._sensors = np.pad(scene.sensors, ((0, 0), (0, self._n_dofs - scene.sensors.shape[1])))
        self._model_shapes: Array | None = None
        if scene.model is not None:
            self._model_shapes = scene.model.modes().shapes[: self._n_dofs]
        self._lines = scene.drawing.lines[: len(scene.drawing.lines) - scene.drawing.beside]
        self._moving = np.flatnonzero((dofs >= 0).any(axis=1))
        self._latest: ModalEstimate | None = None
        self._shown = False

    def draw(self, modes: ModalEstimate | None) -> None:
        """Draw the real parts of the mode shapes at their largest deflection."""
        if not self._moving.size:
            return
        if modes is None:
            if self._shown:
                self._stream.log("/frame/modes", rr.Clear(recursive=True))
            self._shown = False
            return
        self._latest, self._shown = modes, True
        self._draw_phase(self._to, modes, 1.0)
        numbers = modes.model_mode.tolist()
        labels = [f"{f:.2f} Hz" for f in modes.frequencies_hz.tolist()]
        label(self._to, "/frame/modes/labels", list(map(self._plan.mode_label, numbers)), labels, self._colours(modes))

    def animate(self) -> None:
        """Draw one period of the latest mode shapes, with the same number of steps for each mode."""
        if self._latest is None:
            return
        frames = Rows(self._stream, "phase")
        for i in range(_FRAMES):
            frames.at(round(1e9 * i / _FRAMES))
            self._draw_phase(frames, self._latest, np.exp(2j * np.pi * i / _FRAMES))
        frames.send()

    def _draw_phase(self, to: Rows, modes: ModalEstimate, turn: complex) -> None:
        """Draw the mode shapes turned in phase by the complex factor `turn`."""
        lines, strips, dots = self._lines, Strips(), []
        for shape, k in zip(modes.shapes, modes.model_mode.tolist(), strict=True):
            rest = self._plan.points + self._plan.offset(k)
            moved = rest + self._deflection(shape, k, turn)
            strips += [*rest[lines], *moved[lines]]
            dots.append(moved[self._moving])
        colours = self._colours(modes)
        of_strips = np.repeat(np.stack([np.full_like(colours, GREY), colours], axis=1).reshape(-1, 3),
                              len(lines), axis=0)  # fmt: skip
        radii = np.tile(np.repeat([0.003, 0.01], len(lines)), len(colours))
        to.add("/frame/modes", rr.LineStrips3D, strips=strips, colors=of_strips, radii=radii)
        of_dots = np.repeat(colours, self._moving.size, axis=0)
        to.add("/frame/modes/nodes", rr.Points3D, positions=np.concatenate(dots), colors=of_dots, radii=[0.018])

    def _deflection(self, shape: ComplexArray, mode: int, turn: complex) -> Annotated[Array, "n 3"]:
        """Compute the motion of the points: at most `_DEFLECTION` where `turn` is 1."""
        model_shape = np.zeros(self._n_dofs) if self._model_shapes is None else self._model_shapes[:, mode]
        whole = expand_shape(shape, model_shape, self._sensors)
        motion = self._scene.drawing.displaced(whole)
        largest = max(float(np.linalg.norm(motion.real, axis=1).max()), 1e-12)
        return np.asarray((motion * turn).real * (_DEFLECTION / largest))

    @staticmethod
    def _colours(modes: ModalEstimate) -> Colours:
        return np.array(SERIES, dtype=np.uint8)[modes.model_mode % len(SERIES)]
