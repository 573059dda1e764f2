"""What people write: HOST:PORT and times."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def parse_address(text: str, *, any_port: bool = False) -> tuple[str, int]:
    """Host, an IPv6 one without its brackets, and port; 0, a free one, only with `any_port`.

    Raises
    ------
    ValueError
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not (0 if any_port else 1) <= int(port) < 65536:
        raise ValueError(f"{text!r} is not HOST:PORT, as 127.0.0.1:9876")
    return host.strip("[]"), int(port)


def utc_ns(text: str) -> int:
    """Nanoseconds since 1970 of a time in ISO 8601, UTC where it names no zone.

    Raises
    ------
    ValueError
        It is none, or none that 64 bits can say.
    """
    try:
        moment = datetime.fromisoformat(text)
        since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - _EPOCH
    except ValueError:
        raise ValueError(f"{text!r} is no time; write 2026-12-31 or 2026-12-31T23:59:00") from None
    t_ns = since // timedelta(microseconds=1) * 1000
    if not -(1 << 63) <= t_ns < 1 << 63:
        raise ValueError(f"{text!r} lies beyond the years 1678 to 2261")
    return t_ns
