"""Prometheus metrics over HTTP, by default on the loopback address only.

The metrics are built from the latest results, the latest health line and a few counters at the time of each request.
"""

from __future__ import annotations

import logging
import platform
import re
import ssl
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from pydantic import field_validator, model_validator

from monitor import __version__
from monitor.core import WHOLE, Gap, Level, Settings, WindowResult, parse_address
from monitor.damage import State
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.http_server import HttpServer, wsgi

_log = logging.getLogger(__name__)
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

    If the port cannot be opened, `failed` says so, and every health line triggers another attempt; `port` is None until it
    listens.
    """

    failed: str | None = None

    def __init__(self, site: str, settings: MetricsSettings | None, folder: Path = Path()) -> None:
        self.port: int | None = None
        self._site, self._settings, self._folder = site, settings, folder
        self._server: HttpServer | None = None
        self._lock = threading.Lock()
        self._health: Mapping[str, Any] = {}
        self._result: WindowResult | None = None
        self._active: Mapping[int, Level] = {}
        self._left_out: tuple[str, ...] = ()
        self._windows = self._gaps = self._samples = self._dropped = 0
        self._lost_s = 0.0
        self._skipped = dict.fromkeys([*_REASONS.values(), "other"], 0)
        self._findings = 0

    def window(self, result: WindowResult, line: str) -> None:
        """Count a window, and keep its result unless the window was skipped."""
        with self._lock:
            self._windows += 1
            self._active = result.alarm.active
            self._left_out = tuple(gone.channel for gone in result.left_out)
            if result.skipped is None:
                self._result = result
            else:
                self._skipped[reason_class(result.skipped.reason)] += 1

    def gap(self, gap: Gap) -> None:
        """Count a gap and its duration."""
        with self._lock:
            self._gaps += 1
            self._lost_s += max(0.0, gap.duration_s)

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Keep the latest health line; begin to listen if the port is not open."""
        with self._lock:
            self._health = line
            if (stream := line["stream"]) is not None:
                self._samples += stream["samples"]
                self._dropped += stream["overlaps"]
        if self._server is None and self._settings is not None:
            self._listen(self._settings)

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Count a finding."""
        with self._lock:
            self._findings += 1

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.close(timeout_s)

    def collect(self) -> Iterator[Metric]:
        """Build all metrics from the present state."""
        with self._lock:  # released before the answer is sent, so that a slow reader does not hold it
            return iter(list(self._families()))

    def _families(self) -> Iterator[Metric]:
        build = GaugeMetricFamily("shm_build_info", "Versions and site.", labels=("version", "python", "site"))
        build.add_metric((__version__, platform.python_version(), self._site), 1)
        yield build
        states = {state.value: float(state is self.present.state) for state in State}
        text = "State of the structure: 1 for the present one."
        yield _labelled(GaugeMetricFamily, "shm_state", text, states, "state")
        yield CounterMetricFamily("shm_windows", "Windows.", self._windows)
        yield _labelled(CounterMetricFamily, "shm_windows_skipped", "Windows without a word.", self._skipped, "reason")
        yield CounterMetricFamily("shm_samples", "Samples taken, of each channel.", self._samples)
        yield CounterMetricFamily("shm_gaps", "Gaps.", self._gaps)
        yield CounterMetricFamily("shm_lost_seconds", "Data missing in gaps.", self._lost_s)
        yield CounterMetricFamily("shm_dropped_samples", "Repeated, late or not finite.", self._dropped)
        yield CounterMetricFamily("shm_findings", "Diagnoses made.", self._findings)
        text, left_out = "Channels in no use at present.", dict.fromkeys(self._left_out, 1.0)
        yield _labelled(GaugeMetricFamily, "shm_channel_left_out", text, left_out, "channel")
        if self._result is not None:
            yield from _result_metrics(self._result, self._active)
        if self._health:
            yield from _health_metrics(self._health)

    def _listen(self, s: MetricsSettings) -> None:
        """Start the HTTP server; a failure is kept in `failed` and logged once."""
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        try:
            self._server = HttpServer(*s.address, wsgi(make_wsgi_app(registry)), self._tls(s))
            self.port, self.failed = self._server.port, None
        except (OSError, ValueError) as error:
            if self.failed is None:
                _log.error("no metrics at %s for now: %s", s.listen, error)
            self.failed = f"{s.listen}: {error}"

    def _tls(self, s: MetricsSettings) -> ssl.SSLContext | None:
        """Load the certificates; None without one, OSError that names the files where one is missing or not what it should be."""
        if s.certificate is None or s.private_key is None:
            return None
        names = [str(path) for path in (s.certificate, s.private_key, s.client_ca) if path is not None]
        try:
            client_ca = None if s.client_ca is None else str(self._folder / s.client_ca)
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=client_ca)
            context.verify_mode = ssl.CERT_NONE if client_ca is None else ssl.CERT_REQUIRED
            context.load_cert_chain(self._folder / s.certificate, self._folder / s.private_key)
        except OSError as error:
            raise OSError(f"{', '.join(names)}: {error.strerror or error}") from error
        return context


def reason_class(reason: str) -> str:
    """Classify the reason for which a window was skipped.

    Examples
    --------
    >>> reason_class("channel a1 is stuck")
    'stuck_channel'
    """
    return next((name for part, name in _REASONS.items() if re.search(part, reason)), "other")


def _result_metrics(result: WindowResult, active: Mapping[int, Level]) -> Iterator[Metric]:
    """Yield the metrics of the latest window that was not skipped, and the levels of active alarms."""
    assert result.modes is not None
    yield GaugeMetricFamily("shm_window_end_timestamp_seconds", "UTC of the data.", result.t_end_ns * 1e-9)
    yield from _of_stories(result, active) if result.damage is not None else _of_modes(result, active)
    hz = {str(k): float(f) for k, f in enumerate(result.modes.frequencies_hz, start=1)}
    yield _labelled(GaugeMetricFamily, "shm_frequency_hertz", "Natural frequencies.", hz, "mode")
    if result.stiffness is not None:
        yield GaugeMetricFamily(
            "shm_goodness_of_fit", "1 where stiffness explains the change.", result.stiffness.misfit
        )


def _of_stories(result: WindowResult, active: Mapping[int, Level]) -> Iterator[Metric]:
    """Yield the damage index and the alarm of every story."""
    assert result.damage is not None
    stories = [str(j) for j in range(1, len(result.damage.ddi) + 1)]
    for name, help_text, values in (
        ("shm_ddi", "Relative stiffness loss since the baseline.", result.damage.ddi),
        ("shm_ddi_std", "Its standard deviation.", result.damage.ddi_std),
    ):
        shown = {j: float(x) for j, x in zip(stories, values, strict=True)}
        yield _labelled(GaugeMetricFamily, name, help_text, shown, "story")
    ranks = {j: active.get(int(j), Level.NORMAL).rank for j in [*stories, str(WHOLE)]}
    help_text = "0 normal, 1 advisory, 2 warning, 3 alarm; story 0 is the whole structure."
    yield _labelled(GaugeMetricFamily, "shm_alarm_level", help_text, ranks, "story")


def _of_modes(result: WindowResult, active: Mapping[int, Level]) -> Iterator[Metric]:
    """Yield the change and the alarm of every mode, where there is no model; nothing without a baseline."""
    if result.modal is None:
        return
    change = np.expm1(result.modal.ln_frequency).tolist()
    text = "Relative change of the frequency since the baseline, less what covariates explain."
    for name, help_text, values in (
        ("shm_frequency_change", text, change),
        ("shm_frequency_change_std", "Its standard deviation.", result.modal.ln_frequency_std.tolist()),
    ):
        shown = {str(k): x for k, x in enumerate(values, start=1) if np.isfinite(x)}
        yield _labelled(GaugeMetricFamily, name, help_text, shown, "mode")
    m = len(change)
    # A mode's level is the higher one of its frequency's and its shape's.
    ranks = {str(k): max(active.get(p, Level.NORMAL).rank for p in (k, m + k)) for k in range(1, m + 1)}
    ranks[str(WHOLE)] = active.get(WHOLE, Level.NORMAL).rank
    help_text = "0 normal, 1 advisory, 2 warning, 3 alarm; mode 0 is the whole structure."
    yield _labelled(GaugeMetricFamily, "shm_alarm_level", help_text, ranks, "mode")


def _health_metrics(health: Mapping[str, Any]) -> Iterator[Metric]:
    """Yield the metrics of a health line."""
    source, recorder = health["source"], health["recorder"]
    single: list[tuple[type[Any], str, str, Any]] = [
        (GaugeMetricFamily, "shm_source_connected", "Whether the source is open.", source["connected"]),
        (CounterMetricFamily, "shm_source_losses", "Times the source failed.", source["lost"]),
        (CounterMetricFamily, "shm_refused_blocks", "Blocks turned away.", health["refused"]["blocks"]),
        (GaugeMetricFamily, "shm_queue_blocks", "Blocks that wait.", health["queue"]),
        (GaugeMetricFamily, "shm_data_delay_seconds", "Clock less time of the data.", health["delay_s"]),
        (GaugeMetricFamily, "shm_data_age_seconds", "Since the latest data came.", health.get("data_age_s")),
        (GaugeMetricFamily, "shm_latency_max_seconds", "Longest since the start.", 1e-3 * health["latency_ms"]["max"]),
        (GaugeMetricFamily, "shm_uptime_seconds", "Since the start.", health.get("uptime_s")),
        (GaugeMetricFamily, "shm_disk_free_bytes", "Where results go.", health.get("disk_free_bytes")),
    ]
    if (stream := health["stream"]) is not None:
        single += [
            (GaugeMetricFamily, "shm_sample_rate_hertz", "By the source.", stream["rate_hz"]),
            (GaugeMetricFamily, "shm_availability_ratio", "Samples come over due, last span.", stream["availability"]),
        ]
    if recorder is not None:
        single += [
            (GaugeMetricFamily, "shm_recorder_recording", "1 while it records.", recorder["recording"]),
            (CounterMetricFamily, "shm_recorder_lost_blocks", "Blocks not recorded.", recorder["lost_blocks"]),
            (CounterMetricFamily, "shm_recorder_files", "Files begun.", recorder["files"]),
        ]
    for family, name, help_text, value in single:
        if value is not None:
            yield family(name, help_text, float(value))
    yield _labelled(CounterMetricFamily, "shm_source_events", "The driver's counts.", source["counts"], "event")
    for name, help_text, key in (
        ("shm_clock_offset_seconds", "Arrival less time of the samples.", "offset_s"),
        ("shm_clock_drift_ppm", "How much faster than nominal a node samples.", "drift_ppm"),
    ):
        clocks = {c["node"]: c[key] for c in source["clocks"]}
        yield _labelled(GaugeMetricFamily, name, help_text, clocks, "node")
    rms = {c["channel"]: c["rms_m_s2"] for c in health["channels"]}
    yield _labelled(GaugeMetricFamily, "shm_channel_rms_m_s2", "About the mean, last span.", rms, "channel")
    blocked = {name: 1 for name in health["failed"]}
    yield _labelled(GaugeMetricFamily, "shm_output_failed", "Ways out that are blocked.", blocked, "output")
    lost = health.get("lost", {})
    yield _labelled(CounterMetricFamily, "shm_output_lost", "Found no room on its way out.", lost, "output")
    yield _latency(health["latency_ms"]["windows"])


def _latency(windows: Mapping[str, int]) -> Metric:
    """Build the histogram of the latency from the arrival of a window's last sample to its published line."""
    total, buckets = 0, []
    for edge, count in windows.items():
        total += count
        buckets.append(("+Inf" if edge.startswith(">") else str(float(edge.split()[1]) / 1e3), float(total)))
    return HistogramMetricFamily("shm_latency_seconds", "Last sample to published line.", buckets, None)


def _labelled(family: type[Any], name: str, help_text: str, values: Mapping[str, float | None], label: str) -> Metric:
    """Build a metric with one value for each value of a label, up to `_MOST_LABELS`; None values are left out."""
    metric = family(name, help_text, labels=(label,))
    for key, value in list(values.items())[:_MOST_LABELS]:
        if value is not None:
            metric.add_metric((key,), float(value))
    return cast(Metric, metric)
