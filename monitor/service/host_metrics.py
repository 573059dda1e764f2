"""Prometheus metrics of many sites at one address: those of each site with its name as the label ``site``."""

from __future__ import annotations

import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from monitor.core import MissingInputError
from monitor.service.outlets.http_server import HttpServer, wsgi
from monitor.service.outlets.metrics import Metrics
from monitor.service.schedule import State

_ASK_S = 2.0
"""Longest wait for the metrics of a process. [s; judgement: shorter than a scrape]"""


class _Endpoint(Collector):
    """Answer Prometheus over HTTP with metrics of many sites, at `port`; raise MissingInputError where it cannot be opened."""

    def __init__(self, address: tuple[str, int]) -> None:
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        try:
            self._server = HttpServer(*address, wsgi(make_wsgi_app(registry)))
        except OSError as error:
            raise MissingInputError(f"--metrics {address[0]}:{address[1]}: {error.strerror or error}") from error
        self.port = self._server.port

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        self._server.close(timeout_s)


class HostMetrics(_Endpoint):
    """Metrics of the sites of this process: names, what is done with them, and their metrics where they run."""

    def __init__(
        self, address: tuple[str, int], sites: Callable[[], Iterable[tuple[str, State, Metrics | None]]]
    ) -> None:
        self._sites = sites
        super().__init__(address)

    @staticmethod
    def outlet(name: str) -> Metrics:
        """Create the outlet of a site."""
        return Metrics(name, None)

    def collect(self) -> Iterator[Metric]:
        """Build the metrics of all sites from their present states."""
        families: dict[str, Metric] = {}
        states = GaugeMetricFamily("shm_host_site", "What the host does with a site.", labels=("site", "is"))
        for name, present, metrics in self._sites():
            if metrics is not None:
                _add(families, metrics.collect(), {"site": name})
            for state in State:
                states.add_metric((name, state.value), float(state is present))
        yield states
        yield from families.values()


class WorkersMetrics(_Endpoint):
    """Metrics of the sites of several processes, each of which is asked for its own.

    `ports` returns the port of each process on the loopback address, by its number; None while it has none.
    """

    def __init__(self, address: tuple[str, int], ports: Callable[[], Mapping[int, int | None]]) -> None:
        self._ports = ports
        super().__init__(address)

    def collect(self) -> Iterator[Metric]:
        """Ask the processes for their metrics, and put them together."""
        families: dict[str, Metric] = {}
        workers = GaugeMetricFamily("shm_host_worker_up", "Processes of the host that answer.", labels=("worker",))
        for number, port in self._ports().items():
            answer = None if port is None else _ask(port)
            workers.add_metric((str(number),), float(answer is not None))
            if answer is not None:
                _add(families, text_string_to_metric_families(answer), {})
        yield workers
        yield from families.values()


def _add(families: dict[str, Metric], more: Iterable[Metric], labels: Mapping[str, str]) -> None:
    """Add the samples of metrics, with labels besides their own, to those of the same names."""
    for family in more:
        known = families.setdefault(family.name, Metric(family.name, family.documentation, family.type))
        known.samples += [sample._replace(labels={**labels, **sample.labels}) for sample in family.samples]


def _ask(port: int) -> str | None:
    """Fetch the metrics of a process; None if it does not answer."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=_ASK_S) as answer:
            return str(answer.read().decode())
    except (OSError, ValueError):
        return None
