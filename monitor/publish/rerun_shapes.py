"""Mode shapes beside the frame, still on the timeline of data, moving on the timeline ``phase``."""

from __future__ import annotations

import numpy as np
import rerun as rr

from monitor.publish.rerun_scene import GREY, SERIES, Colour, Scene, rows
from monitor.results import Array, ModalEstimate

_FRAMES = 24
_SIZE = 0.2


def label(
    stream: rr.RecordingStream, path: str, places: list[tuple[float, float, float]], labels: list[str],
    colours: list[Colour],
) -> None:  # fmt: skip
    """Words at places."""
    stream.log(path, rr.Points3D(places, labels=labels, colors=colours, radii=[0.0001], show_labels=True))


class Shapes:
    """Draws on one recording; lives in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, heights: Array) -> None:
        self._scene, self._stream = scene, stream
        self._order = sorted(range(len(scene.sensor_floor)), key=scene.sensor_floor.__getitem__)
        self._z = np.append(heights[[scene.sensor_floor[c] - 1 for c in self._order]], 0.0)
        self._latest: ModalEstimate | None = None

    def draw(self, modes: ModalEstimate | None) -> None:
        """Real parts, at their largest; floors without a sensor are left out."""
        if modes is None:
            self._stream.log("/frame/modes", rr.Clear(recursive=True))
            return
        self._latest = modes
        self._strips(modes, 1.0)
        places = [(self._x(k), 0.0, -0.12) for k, *_ in rows(modes)]
        labels = [f"{f:.2f} Hz" for _, f, *_ in rows(modes)]
        label(self._stream, "/frame/modes/labels", places, labels, self._colours(modes))

    def animate(self) -> None:
        """One period of the latest shapes, in as many steps for each mode."""
        if self._latest is None:
            return
        self._stream.reset_time()
        for i in range(_FRAMES):
            self._stream.set_time("phase", duration=i / _FRAMES)
            self._strips(self._latest, np.exp(2j * np.pi * i / _FRAMES))
        self._stream.reset_time()

    def _strips(self, modes: ModalEstimate, turn: complex) -> None:
        strips, floors, z = [], [], self._z
        for shape, (k, *_) in zip(modes.shapes, rows(modes), strict=True):
            largest = max(float(np.abs(shape.real).max()), 1e-12)
            deflection = np.append(np.real(shape[self._order] * turn), 0.0) * (_SIZE / largest)
            x = self._x(k)
            floors.append(np.column_stack([x + deflection, np.zeros_like(z), z]))
            strips += [np.array([(x, 0, 0), (x, 0, 1)]), floors[-1]]
        colours = self._colours(modes)
        of_strips = [c for colour in colours for c in (GREY, colour)]
        radii = [0.004, 0.014] * len(colours)
        self._stream.log("/frame/modes", rr.LineStrips3D(strips, colors=of_strips, radii=radii))
        of_floors = [colour for colour in colours for _ in z]
        self._stream.log("/frame/modes/floors", rr.Points3D(np.concatenate(floors), colors=of_floors, radii=[0.03]))

    @staticmethod
    def _x(mode: int) -> float:
        return 1.15 + 0.55 * mode

    @staticmethod
    def _colours(modes: ModalEstimate) -> list[Colour]:
        return [SERIES[k % len(SERIES)] for k, *_ in rows(modes)]
