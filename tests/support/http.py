"""Ask a server on loopback."""

from __future__ import annotations

import urllib.request
from typing import Any


def fetch(port: int | None, path: str = "/metrics", scheme: str = "http", **options: Any) -> bytes:
    with urllib.request.urlopen(f"{scheme}://127.0.0.1:{port}{path}", timeout=10.0, **options) as answer:
        return bytes(answer.read())
