"""Parsing of text from outside: HOST:PORT, times and JSON."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from typing import Any

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def parse_address(text: str, *, any_port: bool = False) -> tuple[str, int]:
    """Parse HOST:PORT, with a port 0 (any free one) only if `any_port`, else raise ValueError; an IPv6 host loses its brackets.

    Examples
    --------
    >>> parse_address("[::1]:9876")
    ('::1', 9876)
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not (0 if any_port else 1) <= int(port) < 65536:
        raise ValueError(f"{text!r} is not HOST:PORT, as 127.0.0.1:9876")
    return host.strip("[]"), int(port)


def utc(t_ns: float, *, seconds: bool = False) -> str:
    """Write a time, ns since 1970 UTC, to the minute, or to the second, in ISO 8601 without its zone.

    Examples
    --------
    >>> utc(61e9)
    '1970-01-01 00:01'
    >>> utc(61e9, seconds=True)
    '1970-01-01 00:01:01'
    """
    return f"{datetime.fromtimestamp(t_ns * 1e-9, UTC):%Y-%m-%d %H:%M{':%S' if seconds else ''}}"


def utc_ns(text: str) -> int:
    """Convert a time in ISO 8601 (UTC without a zone) to nanoseconds since 1970; ValueError if it is none, or too far away.

    Examples
    --------
    >>> utc_ns("1970-01-01T00:00:01.5")
    1500000000
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


def parse_json(text: str | bytes) -> Any:
    """Parse strict JSON of any origin; ValueError if it holds NaN or an infinity, or is nested too deeply.

    Examples
    --------
    >>> parse_json('{"a": [1, null]}')
    {'a': [1, None]}
    """
    try:
        return json.loads(text, parse_constant=_refuse)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _refuse(constant: str) -> float:
    """Refuse a number that JSON does not have."""
    raise ValueError(f"{constant} is no number of JSON")
