"""Prometheus metrics of many sites at one address: those of each site with its name as the label ``site``."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from monitor.core import MissingInputError
from monitor.service.outlets.http_server import HttpServer
from monitor.service.outlets.metrics import Metrics

_STATES = ("waiting", "running", "ending", "over")
"""What a host may do with a site. [words; monitor.service.host]"""


class HostMetrics(Collector):
    """Answer Prometheus over HTTP with the metrics of many sites.

    Parameters
    ----------
    address : (str, int)
        Host and port; port 0 for any.
    states : callable
        Returns what the host does with each site, by its name.

    Attributes
    ----------
    port : int
        Port at which it listens.

    Raises
    ------
    MissingInputError
        The port cannot be opened.
    """

    def __init__(self, address: tuple[str, int], states: Callable[[], Mapping[str, str]]) -> None:
        self._states = states
        self._sites: dict[str, Metrics] = {}
        self._lock = threading.Lock()
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        try:
            self._server = HttpServer(*address, make_wsgi_app(registry))
        except OSError as error:
            raise MissingInputError(f"--metrics {address[0]}:{address[1]}: {error.strerror or error}") from error
        self.port = self._server.port

    def outlet(self, name: str) -> Metrics:
        """Create the outlet of a site, whose metrics are shown from then on."""
        outlet = Metrics(name, None)
        with self._lock:
            self._sites[name] = outlet
        return outlet

    def remove(self, name: str) -> None:
        """Show the metrics of a site no more."""
        with self._lock:
            self._sites.pop(name, None)

    def collect(self) -> Iterator[Metric]:
        """Build the metrics of all sites from their present states."""
        with self._lock:
            sites = list(self._sites.items())
        families: dict[str, Metric] = {}
        for name, outlet in sites:
            for family in outlet.collect():
                known = families.setdefault(family.name, Metric(family.name, family.documentation, family.type))
                known.samples += [s._replace(labels={"site": name, **s.labels}) for s in family.samples]
        states = GaugeMetricFamily("shm_host_site", "What the host does with a site.", labels=("site", "is"))
        for name, present in self._states().items():
            for state in _STATES:
                states.add_metric((name, state), float(state == present))
        yield states
        yield from families.values()

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        self._server.close(timeout_s)
