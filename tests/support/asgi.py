"""Ask an ASGI application without a socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

Answer = tuple[int, dict[str, str], bytes]


def ask(application: Callable[..., Any], path: str, method: str = "GET", **fields: str) -> Answer:
    """Return code, headers and body; a field's name has _ for -."""
    path, _, query = path.partition("?")
    headers = {"Host": "127.0.0.1:8080", **{name.replace("_", "-"): value for name, value in fields.items()}}
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": unquote(path),
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "headers": [(name.lower().encode(), value.encode("latin-1")) for name, value in headers.items()],
    }
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    asyncio.run(application(scope, receive, send))
    begun, *parts = sent
    told = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in begun["headers"]}
    return begun["status"], told, b"".join(part.get("body", b"") for part in parts)
