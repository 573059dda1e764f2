"""A main loop that takes operators' requests and answers them, for tests of an outlet alone."""

from __future__ import annotations

import threading
from typing import Self

from monitor.service import Request
from monitor.service.outlets.base import Outlet
from monitor.service.requests import Answer


class Monitor:
    """A main loop that takes the requests of an outlet and answers them."""

    def __init__(self, out: Outlet, refuse: str = "") -> None:
        self._out, self._refuse = out, refuse
        self.applied: list[Request] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(0.01):
            if self._refuse:
                self._out.refuse_requests(self._refuse)
                continue
            requests = self._out.take_requests()
            self.applied += requests
            self._out.answer_requests([Answer()] * len(requests))
