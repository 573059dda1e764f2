"""The force of a law."""

from __future__ import annotations

from typing import Any


def force(law: Any, displacement: float, velocity: float) -> float:
    from monitor.model.integration import phi  # compiled code takes a while to load

    return float(phi(int(law.kind), *law.parameters, displacement, velocity))
