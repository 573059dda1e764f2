"""The viewer's answer to "can I trust it": sensors, clocks, goodness of fit, verdict."""

from __future__ import annotations

from typing import Any

import rerun as rr

from monitor.publish.viewer.rows import Rows
from monitor.publish.viewer.scene import GREY, RED, SERIES, Clocks, Scene, utc
from monitor.signals import Health


class TrustDrawing:
    """Draws on one recording; lives in the worker's thread."""

    def __init__(self, scene: Scene, stream: rr.RecordingStream, to: Rows) -> None:
        self._scene, self._stream, self._to = scene, stream, to
        self._told = False

    def begin(self) -> None:
        """Names and colours."""
        for i, channel in enumerate(self._scene.channels):
            colour = SERIES[i % len(SERIES)]
            for kind in ("rms", "noise_floor", "clipped"):
                line = rr.SeriesLines(names=[channel], colors=[colour])
                self._stream.log(f"/quality/{kind}/{rr.escape_entity_path_part(channel)}", line, static=True)
        self._stream.log("/trust/misfit/line", rr.SeriesLines(names=["misfit"], colors=[SERIES[0]]), static=True)
        self._stream.log("/trust/misfit/one", rr.SeriesLines(names=["expected"], colors=[GREY]), static=True)
        self._stream.log(
            "/trust/misfit/asks", rr.SeriesLines(names=["a diagnosis is asked for"], colors=[RED]), static=True
        )

    def misfit(self, value: float | None) -> None:
        """Goodness of fit; the stream stands at the window's end."""
        if not self._told:
            self._verdict("No diagnosis was asked for so far.")
        if value is not None:
            lines = (("line", value), ("one", 1.0), ("asks", self._scene.misfit_threshold))
            for name, size in lines:
                self._to.scalars(f"/trust/misfit/{name}", size)

    def health(self, health: Health) -> None:
        """A span of the sensors."""
        self._to.at(health.t_end_ns)
        self._to.scalars("/quality/availability", 100.0 * health.availability)
        for c in health.channels:
            name = rr.escape_entity_path_part(c.channel)
            for kind, value in (("rms", c.rms_m_s2), ("noise_floor", c.noise_floor), ("clipped", 100.0 * c.clipped)):
                self._to.scalars(f"/quality/{kind}/{name}", value)

    def clocks(self, told: Clocks) -> None:
        """Offset of every node's clock, ms."""
        self._stream.set_time("time", timestamp=utc(told.t_ns))
        for clock in told.clocks:
            path = f"/clock/{rr.escape_entity_path_part(clock.node)}"
            self._stream.log(path, rr.Scalars(1000.0 * clock.offset_s))

    def finding(self, finding: dict[str, Any]) -> None:
        """What a diagnosis said, at the end of its data."""
        self._stream.set_time("time", timestamp=utc(finding["t_ns"]))
        verdict = finding.get("verdict") or "failed"
        says = finding.get("says") or finding.get("error") or ""
        text = f"# {verdict}\n\n{says}\n\nAsked because: {finding.get('reason', '')}"
        if what := finding.get("separating_measurement"):
            text += f"\n\nTo tell the alternatives apart: {what}"
        self._verdict(text)
        self._stream.log("/events", rr.TextLog(f"diagnosis: {verdict}: {says}", level=rr.TextLogLevel.INFO))

    def _verdict(self, text: str) -> None:
        self._told = True
        self._stream.log("/verdict", rr.TextDocument(text, media_type="text/markdown"))
