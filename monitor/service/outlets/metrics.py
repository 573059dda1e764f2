"""Prometheus metrics over HTTP, by default on the loopback address only.

The metrics are built from the latest results, the latest health line and a few counters at the time of each request.
"""

from __future__ import annotations

import platform
import re
import ssl
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from prometheus_client import CollectorRegistry, make_asgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from pydantic import field_validator, model_validator

from monitor import __version__
from monitor.core import WHOLE, Array, Gap, Level, Settings, WindowResult, parse_address
from monitor.damage import State
from monitor.service.outlets.base import Outlet

if TYPE_CHECKING:
    from monitor.service.outlets.http_server import HttpServer

_MOST_LABELS = 256
"""Largest number of values of one label: names that nodes on the bus give themselves must not fill the database."""
_REASONS = {
    "gap": "gap",
    "does not move": "dead_channel",
    "is stuck": "stuck_channel",
    "is clipped": "clipped_channel",
    "noise": "noise",
    "beyond the band": "beyond_band",
    "updating": "updating",
    "mode": "modes",
}
"""Pattern in a reason -> class of the reason; the first pattern that matches counts."""
_COUNTED = {
    "shm_windows": "Windows.",
    "shm_samples": "Samples taken, of each channel.",
    "shm_gaps": "Gaps.",
    "shm_lost_seconds": "Data missing in gaps.",
    "shm_dropped_samples": "Repeated, late or not finite.",
    "shm_findings": "Diagnoses made.",
}
"""Name of a count -> what is counted. [none; definition]"""
_GAUGE, _COUNTER = GaugeMetricFamily, CounterMetricFamily
_Row = tuple[type[Any], str, str, Any, str | tuple[str, ...]]
"""Kind, name, meaning, value or values, label or labels."""


class MetricsSettings(Settings):
    """``[output.metrics]`` of the site file."""

    listen: str = "127.0.0.1:9464"
    """HOST:PORT to listen at."""
    certificate: Path | None = None
    """PEM file for TLS, relative to the site file, as are `private_key` and `client_ca`."""
    private_key: Path | None = None
    """PEM file of the certificate's private key."""
    client_ca: Path | None = None
    """PEM file of the authority that signs the readers' certificates; with it, readers must present one."""

    @field_validator("listen")
    @classmethod
    def _listens(cls, text: str) -> str:
        parse_address(text, any_port=True)
        return text

    @model_validator(mode="after")
    def _sound(self) -> MetricsSettings:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("certificate and private_key go together")
        if self.client_ca is not None and self.certificate is None:
            raise ValueError("client_ca needs certificate and private_key")
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of `listen`."""
        return parse_address(self.listen, any_port=True)


class Metrics(Collector, Outlet):
    """Answer Prometheus over HTTP with the latest results and counts; without settings only `collect` is asked.

    Every health line tries to open the port again where that failed.
    """

    def __init__(self, site: str, settings: MetricsSettings | None, folder: Path = Path()) -> None:
        self._site, self._lock = site, threading.Lock()
        self._server = None if settings is None else _server(settings, folder, self)
        self._health: Mapping[str, Any] = {}
        self._result: WindowResult | None = None
        self._active: Mapping[int, Level] = {}
        self._left_out: tuple[str, ...] = ()
        self._counts = dict.fromkeys(_COUNTED, 0.0)
        self._skipped = dict.fromkeys([*_REASONS.values(), "other"], 0)

    @property
    def port(self) -> int | None:
        """Number of the port; None until it listens."""
        return None if self._server is None else self._server.port

    @property
    def failed(self) -> str | None:
        """Why the port could not be opened; None if it was."""
        return None if self._server is None else self._server.failed

    def window(self, result: WindowResult, line: str) -> None:
        """Count a window, and keep its result unless the window was skipped."""
        with self._lock:
            self._counts["shm_windows"] += 1
            self._active = result.alarm.active
            self._left_out = tuple(gone.channel for gone in result.left_out)
            if result.skipped is None:
                self._result = result
            else:
                self._skipped[reason_class(result.skipped.reason)] += 1

    def gap(self, gap: Gap) -> None:
        """Count a gap and its duration."""
        with self._lock:
            self._counts["shm_gaps"] += 1
            self._counts["shm_lost_seconds"] += max(0.0, gap.duration_s)

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Keep the latest health line; listen if the port is not open."""
        with self._lock:
            self._health = line
            if (stream := line["stream"]) is not None:
                self._counts["shm_samples"] += stream["samples"]
                self._counts["shm_dropped_samples"] += stream["overlaps"]
        if self._server is not None:
            self._server.open()

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Count a finding."""
        with self._lock:
            self._counts["shm_findings"] += 1

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.close(timeout_s)

    def collect(self) -> Iterator[Metric]:
        """Build all metrics from the present state."""
        with self._lock:  # released before the answer is sent, so that a slow reader does not hold it
            families = [_family(*row) for row in self._rows() if row[3] is not None]
            return iter([*families, _latency(self._health["latency_ms"]["windows"])] if self._health else families)

    def _rows(self) -> Iterator[_Row]:
        version = (__version__, platform.python_version(), self._site)
        yield _GAUGE, "shm_build_info", "Versions and site.", {version: 1.0}, ("version", "python", "site")
        states = {state.value: state is self.present.state for state in State}
        yield _GAUGE, "shm_state", "State of the structure: 1 for the present one.", states, "state"
        for name, says in _COUNTED.items():
            yield _COUNTER, name, says, self._counts[name], ""
        yield _COUNTER, "shm_windows_skipped", "Windows without a word.", self._skipped, "reason"
        left_out = dict.fromkeys(self._left_out, 1)
        yield _GAUGE, "shm_channel_left_out", "Channels in no use at present.", left_out, "channel"
        if self._result is not None:
            yield from _result_rows(self._result, self._active)
        if self._health:
            yield from _health_rows(self._health)


def metrics_application(collector: Collector) -> Callable[..., Any]:
    """Make the ASGI application that answers every request by the metrics of a collector."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    return make_asgi_app(registry)


def _server(s: MetricsSettings, folder: Path, collector: Collector) -> HttpServer:
    from monitor.service.outlets.http_server import HttpServer  # loads uvicorn

    files = {"ssl_certfile": s.certificate, "ssl_keyfile": s.private_key, "ssl_ca_certs": s.client_ca}
    tls = {key: str(folder / path) for key, path in files.items() if path is not None}
    asked = ssl.CERT_NONE if s.client_ca is None else ssl.CERT_REQUIRED
    return HttpServer("metrics", s.address, metrics_application(collector), {**tls, "ssl_cert_reqs": asked})


def reason_class(reason: str) -> str:
    """Classify the reason for which a window was skipped.

    Examples
    --------
    >>> reason_class("channel a1 is stuck")
    'stuck_channel'
    """
    return next((name for part, name in _REASONS.items() if re.search(part, reason)), "other")


def _result_rows(result: WindowResult, active: Mapping[int, Level]) -> Iterator[_Row]:
    """Metrics of the latest window that was not skipped, and the levels of active alarms."""
    assert result.modes is not None
    yield _GAUGE, "shm_window_end_timestamp_seconds", "UTC of the data.", result.t_end_ns * 1e-9, ""
    if (damage := result.damage) is not None:
        text = "Relative stiffness loss since the baseline."
        yield from _judged("story", "shm_ddi", text, damage.ddi, damage.ddi_std, 1, active)
    elif (modal := result.modal) is not None:
        text = "Relative change of the frequency since the baseline, less what covariates explain."
        change, std = np.expm1(modal.ln_frequency), modal.ln_frequency_std
        yield from _judged("mode", "shm_frequency_change", text, change, std, 2, active)
    yield _GAUGE, "shm_frequency_hertz", "Natural frequencies.", _numbered(result.modes.frequencies_hz), "mode"
    fit = None if result.stiffness is None else result.stiffness.misfit
    yield _GAUGE, "shm_goodness_of_fit", "1 where stiffness explains the change.", fit, ""


def _judged(
    part: str, name: str, says: str, values: Array, std: Array, each: int, active: Mapping[int, Level]
) -> Iterator[_Row]:
    """What is judged of every part, and its alarm: the highest of `each` numbers (a mode's frequency and its shape)."""
    yield _GAUGE, name, says, _numbered(values), part
    yield _GAUGE, f"{name}_std", "Its standard deviation.", _numbered(std), part
    m = len(values)
    numbers = {WHOLE: [WHOLE]} | {k: [k + more * m for more in range(each)] for k in range(1, m + 1)}
    ranks = {str(k): max(active.get(one, Level.NORMAL).rank for one in of) for k, of in numbers.items()}
    text = f"0 normal, 1 advisory, 2 warning, 3 alarm; {part} 0 is the whole structure."
    yield _GAUGE, "shm_alarm_level", text, ranks, part


def _numbered(values: Array) -> dict[str, float]:
    return {str(k): float(x) for k, x in enumerate(values, start=1) if np.isfinite(x)}


def _health_rows(health: Mapping[str, Any]) -> Iterator[_Row]:
    """Metrics of a health line but its latency."""
    source, stream, recorder = health["source"], health["stream"] or {}, health["recorder"] or {}
    clocks = {key: {c["node"]: c[key] for c in source["clocks"]} for key in ("offset_s", "drift_ppm")}
    rms = {c["channel"]: c["rms_m_s2"] for c in health["channels"]}
    failed = dict.fromkeys(health["failed"], 1)
    latency_s = 1e-3 * health["latency_ms"]["max"]
    yield from (
        (_GAUGE, "shm_source_connected", "Whether the source is open.", source["connected"], ""),
        (_COUNTER, "shm_source_losses", "Times the source failed.", source["lost"], ""),
        (_COUNTER, "shm_refused_blocks", "Blocks turned away.", health["refused"]["blocks"], ""),
        (_GAUGE, "shm_queue_blocks", "Blocks that wait.", health["queue"], ""),
        (_GAUGE, "shm_data_delay_seconds", "Clock less time of the data.", health["delay_s"], ""),
        (_GAUGE, "shm_data_age_seconds", "Since the latest data came.", health.get("data_age_s"), ""),
        (_GAUGE, "shm_latency_max_seconds", "Longest since the start.", latency_s, ""),
        (_GAUGE, "shm_uptime_seconds", "Since the start.", health.get("uptime_s"), ""),
        (_GAUGE, "shm_disk_free_bytes", "Where results go.", health.get("disk_free_bytes"), ""),
        (_GAUGE, "shm_sample_rate_hertz", "By the source.", stream.get("rate_hz"), ""),
        (_GAUGE, "shm_availability_ratio", "Samples come over due, last span.", stream.get("availability"), ""),
        (_GAUGE, "shm_recorder_recording", "1 while it records.", recorder.get("recording"), ""),
        (_COUNTER, "shm_recorder_lost_blocks", "Blocks not recorded.", recorder.get("lost_blocks"), ""),
        (_COUNTER, "shm_recorder_files", "Files begun.", recorder.get("files"), ""),
        (_COUNTER, "shm_source_events", "The driver's counts.", source["counts"], "event"),
        (_GAUGE, "shm_clock_offset_seconds", "Arrival less time of the samples.", clocks["offset_s"], "node"),
        (_GAUGE, "shm_clock_drift_ppm", "How much faster than nominal a node samples.", clocks["drift_ppm"], "node"),
        (_GAUGE, "shm_channel_rms_m_s2", "About the mean, last span.", rms, "channel"),
        (_GAUGE, "shm_output_failed", "Ways out that are blocked.", failed, "output"),
        (_COUNTER, "shm_output_lost", "Found no room on its way out.", health.get("lost", {}), "output"),
    )


def _latency(windows: Mapping[str, int]) -> Metric:
    """Build the histogram of the latency from the arrival of a window's last sample to its published line."""
    total, buckets = 0, []
    for edge, count in windows.items():
        total += count
        buckets.append(("+Inf" if edge.startswith(">") else str(float(edge.split()[1]) / 1e3), float(total)))
    return HistogramMetricFamily("shm_latency_seconds", "Last sample to published line.", buckets, None)


def _family(kind: type[Any], name: str, says: str, value: Any, labels: str | tuple[str, ...]) -> Metric:
    """Build a metric: a number, or one for each value of a label, up to `_MOST_LABELS`; what is None has no sample."""
    labels = (labels,) if isinstance(labels, str) and labels else tuple(labels)
    family = kind(name, says, labels=labels)
    for key, number in list(value.items() if labels else [((), value)])[:_MOST_LABELS]:
        if number is not None:
            family.add_metric((key,) if isinstance(key, str) else key, float(number))
    return cast(Metric, family)
