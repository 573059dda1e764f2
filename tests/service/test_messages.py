"""An outlet on a network joins it again after a failure, and sends the message that met the failure once more."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from monitor.core import Gap, Worker
from monitor.service.outlets.messages import Messages


class NoPrefix(BaseModel):
    """Settings of a network that breaks."""

    prefix: str | None = None


class Breaking(Messages[NoPrefix]):
    """Outlet on a network of which the second sending fails."""

    network: ClassVar[str] = "bench"

    def __init__(self) -> None:
        super().__init__("bench", NoPrefix(), queue_size=3)
        self.did: list[str] = []
        self._worker.start()

    def _join(self) -> None:
        self.did.append("join")

    def _send(self, name: str, text: str) -> None:
        self.did.append(f"{'fail' if len(self.did) == 2 else 'send'} {text.partition(',')[0]}")
        if self.did[-1].startswith("fail"):
            raise OSError("the cable is out")

    def _say_farewell(self) -> None:
        self.did.append("farewell")

    def _leave(self) -> None:
        self.did.append("leave")


def test_a_message_that_meets_a_failure_is_sent_again_after_the_network_was_joined_anew() -> None:
    now_s = [0.0]
    with Worker.by_hand(lambda: now_s[0]) as hand:
        outlet = Breaking()
        for k in range(2):
            outlet.gap(Gap(k, 1.0, "lost"))
        while hand.step():
            continue
        assert outlet.failed == "OSError: the cable is out"
        for k in range(2, 6):
            outlet.gap(Gap(k, 1.0, "lost"))
        now_s[0] = 1.0
        outlet.close(1.0)
    sent = ["join", 'send {"t_ns": 0', 'fail {"t_ns": 1', "leave", "join", 'send {"t_ns": 1']
    assert outlet.did == [*sent, *(f'send {{"t_ns": {k}' for k in (3, 4, 5)), "farewell", "leave"]
    assert outlet.failed is None and outlet.dropped == 1
