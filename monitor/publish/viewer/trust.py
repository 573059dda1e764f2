"""Drawing of what the trust in a result rests on: sensors, clocks, goodness of fit, verdict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr

from monitor.publish.viewer.rows import Rows, name_line
from monitor.publish.viewer.scene import GREY, RED, SERIES, Clocks, Scene
from monitor.publish.viewer.state import PLAIN, event_text
from monitor.signals import Health

VERDICTS = {
    "named": "Cause named",
    "ambiguous": "Cause ambiguous",
    "unexplained": "Misfit unexplained",
    "none": "No cause found",
}
"""Verdicts of a diagnosis as people read them."""


class TrustDrawing:
    """Drawing of sensors, clocks, goodness of fit and verdict into one recording, in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, to: Rows) -> None:
        self._scene, self._stream, self._to = scene, stream, to
        self._has_verdict = False

    def begin(self) -> None:
        """Draw the names and the colours."""
        for i, channel in enumerate(self._scene.channels):
            for kind in ("rms", "noise_floor", "clipped"):
                path = f"/quality/{kind}/{rr.escape_entity_path_part(channel)}"
                name_line(self._stream, path, channel, SERIES[i % len(SERIES)])
        lines = [("misfit/line", "misfit", SERIES[0]), ("misfit/one", "expected", GREY)]
        lines += [("misfit/asks", "a diagnosis is asked for", RED)]
        for name, learned in self._scene.learned.items():
            path = f"covariate/{rr.escape_entity_path_part(name)}"
            lines += [(f"{path}/value", learned.unit, SERIES[0])]
            lines += [(f"{path}/{side}", f"{side}est at calibration", GREY) for side in ("low", "high")]
        for path, name, colour in lines:
            name_line(self._stream, f"/trust/{path}", name, colour)

    def covariates(self, values: Mapping[str, float]) -> None:
        """Draw each covariate beside the range that calibration learned from; the recording's time is the window's end."""
        for name, learned in self._scene.learned.items():
            if name in values:
                path = f"/trust/covariate/{rr.escape_entity_path_part(name)}"
                for line, size in (("value", values[name]), ("low", learned.low), ("high", learned.high)):
                    self._to.scalars(f"{path}/{line}", size)

    def misfit(self, value: float | None) -> None:
        """Draw the goodness of fit; the recording's time is the window's end."""
        if not self._has_verdict:
            none = "No diagnosis was asked for so far."
            self._verdict(
                none if self._scene.n_stories else "No diagnosis: it needs a model, and the modes alone are judged."
            )
        if value is not None:
            lines = (("line", value), ("one", 1.0), ("asks", self._scene.misfit_threshold))
            for name, size in lines:
                self._to.scalars(f"/trust/misfit/{name}", size)

    def health(self, health: Health) -> None:
        """Draw the sensors' health in a span."""
        self._to.at(health.t_end_ns)
        self._to.scalars("/quality/availability", 100.0 * health.availability)
        for c in health.channels:
            name = rr.escape_entity_path_part(c.channel)
            for kind, value in (("rms", c.rms_m_s2), ("noise_floor", c.noise_floor), ("clipped", 100.0 * c.clipped)):
                self._to.scalars(f"/quality/{kind}/{name}", value)

    def clocks(self, state: Clocks) -> None:
        """Draw the offset of every node's clock, ms."""
        self._stream.set_time("time", timestamp=np.datetime64(state.t_ns, "ns"))
        for clock in state.clocks:
            path = f"/clock/{rr.escape_entity_path_part(clock.node)}"
            self._stream.log(path, rr.Scalars(1000.0 * clock.offset_s))

    def finding(self, finding: dict[str, Any]) -> None:
        """Draw the finding of a diagnosis at the end of its data."""
        self._stream.set_time("time", timestamp=np.datetime64(finding["t_ns"], "ns"))
        verdict = VERDICTS.get(finding.get("verdict") or "", "Diagnosis failed")
        says = finding.get("says") or finding.get("error") or ""
        text = f"# {verdict}\n\n{says}\n\nAsked because: {finding.get('reason', '')}"
        if what := finding.get("separating_measurement"):
            text += f"\n\nTo tell the alternatives apart: {what}"
        self._verdict(text)
        event = event_text(finding["t_ns"], f"diagnosis: {verdict.lower()}: {says}")
        self._stream.log("/events", rr.TextLog(event, level=rr.TextLogLevel.INFO, color=PLAIN))

    def _verdict(self, text: str) -> None:
        self._has_verdict = True
        self._stream.log("/verdict", rr.TextDocument(text, media_type="text/markdown"))
