"""Drawing of the mode shapes beside the frame: still on the timeline ``time`` of the data, moving on the timeline ``phase``."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from monitor.core import Array, ModalEstimate
from monitor.publish.viewer.rows import Rows, Strips
from monitor.publish.viewer.scene import GREY, SERIES, Scene

Colours = NDArray[np.uint8]
"""Colours of the modes, shape (.., 3)."""

_FRAMES = 24
"""Number of steps of the animation."""
_DEFLECTION = 0.2
"""Largest deflection of a drawn mode shape, over the height of the frame."""


def label(rows: Rows, path: str, places: list[tuple[float, float, float]], labels: list[str], colours: Colours) -> None:
    """Draw texts at places."""
    rows.add(path, rr.Points3D, positions=places, labels=labels, colors=colours, radii=[0.0001], show_labels=[True])


class ModeShapes:
    """Drawing of the mode shapes into one recording, in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, to: Rows, heights: Array) -> None:
        self._scene, self._stream, self._to = scene, stream, to
        self._order = sorted(range(len(scene.sensor_floor)), key=scene.sensor_floor.__getitem__)
        self._z = np.append(heights[[scene.sensor_floor[c] - 1 for c in self._order]], 0.0)
        self._latest: ModalEstimate | None = None
        self._shown = False

    def draw(self, modes: ModalEstimate | None) -> None:
        """Draw the real parts of the mode shapes at their largest deflection, without the floors that have no sensor."""
        if modes is None:
            if self._shown:
                self._stream.log("/frame/modes", rr.Clear(recursive=True))
            self._shown = False
            return
        self._latest, self._shown = modes, True
        self._draw_phase(self._to, modes, 1.0)
        places = [(self._x(k), 0.0, -0.12) for k in modes.model_mode.tolist()]
        labels = [f"{f:.2f} Hz" for f in modes.frequencies_hz.tolist()]
        label(self._to, "/frame/modes/labels", places, labels, self._colours(modes))

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
        strips, floors, z = Strips(), [], self._z
        for shape, k in zip(modes.shapes, modes.model_mode.tolist(), strict=True):
            largest = max(float(np.abs(shape.real).max()), 1e-12)
            deflection = np.append(np.real(shape[self._order] * turn), 0.0) * (_DEFLECTION / largest)
            x = self._x(k)
            floors.append(np.column_stack([x + deflection, np.zeros_like(z), z]))
            strips += [np.array([(x, 0, 0), (x, 0, 1)]), floors[-1]]
        colours = self._colours(modes)
        of_strips = np.stack([np.full_like(colours, GREY), colours], axis=1).reshape(-1, 3)
        radii = [0.004, 0.014] * len(colours)
        to.add("/frame/modes", rr.LineStrips3D, strips=strips, colors=of_strips, radii=radii)
        of_floors = np.repeat(colours, len(z), axis=0)
        to.add("/frame/modes/floors", rr.Points3D, positions=np.concatenate(floors), colors=of_floors, radii=[0.03])

    @staticmethod
    def _x(mode: int) -> float:
        """Compute the place of a mode beside the frame."""
        return 1.15 + 0.55 * mode

    @staticmethod
    def _colours(modes: ModalEstimate) -> Colours:
        return np.array(SERIES, dtype=np.uint8)[modes.model_mode % len(SERIES)]
