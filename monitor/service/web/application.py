"""The web application: pages and JSON endpoints, who may read them, and what a browser may do with them."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from monitor.config import security_check
from monitor.publish import live_page, page_file
from monitor.service.web.description import describe
from monitor.service.web.live_page import LivePage
from monitor.service.web.snapshots import DEFAULT_LIMIT, MOST_IN_ANSWER, Answer, Snapshots

API = "/api/v1"
"""Beginning of the paths of the endpoints. [name; contract]"""
_FILES = {
    "/api": ("api.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/api.js": ("api.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/uplot.js": ("uplot.js", "text/javascript; charset=utf-8"),
    "/uplot.css": ("uplot.css", "text/css; charset=utf-8"),
    "/uplot-LICENSE.txt": ("uplot-LICENSE.txt", "text/plain; charset=utf-8"),
}
"""Path -> file and its type. [none; definition]"""
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Fields of every answer: a browser loads nothing from elsewhere, and keeps nothing. [none; definition]"""
_ZIP_LEVEL = 1
"""Level of compression. [1; cost: the fastest]"""
_LARGEST_NS = (1 << 63) - 1


def make_application(snapshots: Snapshots, token: str | None) -> Starlette:
    """Make the ASGI application.

    A request for data must hold the field ``Authorization: Bearer TOKEN``.  Without a token anyone may read, but only by a
    name of this machine's own, so that a page from elsewhere cannot lead a browser here by a name of its own.
    """
    routes = [Route(path, _page(page_file(name), kind)) for path, (name, kind) in _FILES.items()]
    routes.append(Route("/", _page(live_page().encode(), "text/html; charset=utf-8")))
    page = LivePage(snapshots)
    routes.append(Route(f"{API}/page", _endpoint(lambda request: page.answer(*_shown(request)))))
    routes.append(Route(f"{API}/report", _report(page)))
    endpoints: dict[str, Callable[[Request], Answer]] = {
        "status": lambda _: snapshots.status_answer(),
        "windows": lambda request: snapshots.windows_answer(*_range(request)),
        "events": lambda _: snapshots.events_answer(),
        "findings": lambda _: snapshots.findings_answer(),
        "alarms": lambda _: snapshots.alarms_answer(),
        "sensors": lambda _: snapshots.sensors_answer(),
    }
    routes += [Route(f"{API}/{name}", _endpoint(make)) for name, make in endpoints.items()]
    routes.append(Route("/openapi.json", _described))
    middleware = [
        Middleware(_Guard, token=token),
        Middleware(GZipMiddleware, minimum_size=1000, compresslevel=_ZIP_LEVEL),
    ]
    application = Starlette(routes=routes, middleware=middleware, exception_handlers={HTTPException: _refusal})
    application.router.redirect_slashes = False  # a redirection would repeat the name that the reader asked for
    return application


class _Guard:
    """Refuse who may not read, and add the fields of every answer."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def add(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        refusal = self._refusal(scope)
        await (self._app if refusal is None else refusal)(scope, receive, add)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if self._token is None:
            host = headers.get("host", "")
            name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
            if security_check.is_loopback(name):
                return None
            return _error(403, "without a token the page is read under the names 127.0.0.1 and localhost only")
        if not str(scope["path"]).startswith(f"{API}/"):
            return None
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and hmac.compare_digest(given.strip().encode(), self._token.encode()):
            return None
        return _error(401, "a token is needed: Authorization: Bearer TOKEN", {"WWW-Authenticate": "Bearer"})


def _page(content: bytes, kind: str) -> Callable[[Request], Awaitable[Response]]:
    async def answer(_: Request) -> Response:
        return Response(content, media_type=kind)

    return answer


def _endpoint(make: Callable[[Request], Answer]) -> Callable[[Request], Awaitable[Response]]:
    """Answer with the tag; without the body where the reader has it already."""

    async def answer(request: Request) -> Response:
        made = make(request)
        if request.headers.get("if-none-match") == made.etag:
            return Response(status_code=304, headers={"ETag": made.etag})
        return Response(made.body, media_type="application/json", headers={"ETag": made.etag})

    return answer


async def _described(_: Request) -> Response:
    return JSONResponse(describe(API))


async def _refusal(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _error(error.status_code, error.detail, error.headers)


def _error(status: int, text: str, headers: Any = None) -> Response:
    return JSONResponse({"error": text}, status, headers)


def _range(request: Request) -> tuple[int | None, int]:
    """Read `since_ns` and `limit` of a request; HTTPException tells that one is no whole number within its bounds."""
    since, limit = request.query_params.get("since_ns"), request.query_params.get("limit", str(DEFAULT_LIMIT))
    return (
        None if since is None else _whole("since_ns", since, 0, _LARGEST_NS),
        _whole("limit", limit, 1, MOST_IN_ANSWER),
    )


def _shown(request: Request) -> tuple[int, str]:
    """Read `range_s`, 0 for all, and the tag of the charts that the reader has."""
    return _whole("range_s", request.query_params.get("range_s", "0"), 0, _LARGEST_NS), request.query_params.get(
        "charts", ""
    )


def _report(page: LivePage) -> Callable[[Request], Awaitable[Response]]:
    async def answer(request: Request) -> Response:
        return Response(page.sheet(_shown(request)[0]).html(), media_type="text/html")

    return answer


def _whole(name: str, text: str, least: int, most: int) -> int:
    if text.isascii() and text.isdecimal() and len(text) < 20 and least <= int(text) <= most:
        return int(text)
    raise HTTPException(400, f"{name} is a whole number from {least} to {most}")
