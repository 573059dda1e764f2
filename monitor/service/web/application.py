"""The web application: pages and JSON endpoints, who may read them, and what a browser may do with them."""

from __future__ import annotations

import hmac
import json
import sys
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from monitor import __version__
from monitor.config import security_check
from monitor.publish import api_page, live_page, page_file
from monitor.service.web.live_page import LivePage, Shown
from monitor.service.web.snapshots import ENDPOINTS, PARTS, Answer, Range, Schema, Snapshots, described, part

API = "/api/v1"
"""Beginning of the paths of the endpoints. [name; contract]"""
_NAMES = "page.js live.js page.css icon.svg uplot.js uplot.css uplot-LICENSE.txt"
"""Files of the pages, each at its own path. [names; definition]"""
_KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".txt": "text/plain"}
"""Suffix of a page's file -> its type. [none; definition]"""
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Fields of every answer: a browser loads nothing from elsewhere, and keeps nothing. [none; definition]"""
_ASKED = {"windows": (Range,)}
"""Endpoint -> what a request gives it. [none; definition]"""
_REFUSALS = {
    "304": {"description": "Nothing has changed."},
    "400": {"description": "A parameter is out of its range."},
    "401": {"description": "The token is missing or wrong."},
    "403": {"description": "Without a token: asked for under another name than 127.0.0.1 or localhost."},
}
"""Code -> what it says, of every endpoint. [none; definition]"""
_ABOUT = (
    "Read-only results of one monitor. Times are UTC, ns since 1970; units are SI and stand in the names. Every answer has an "
    "ETag: a request with If-None-Match is answered by 304 while nothing has changed."
)


def make_application(snapshots: Snapshots, token: str | None) -> Starlette:
    """Make the ASGI application.

    A request for data must hold the field ``Authorization: Bearer TOKEN``.  Without a token anyone may read, but only by a
    name of this machine's own, so that a page from elsewhere cannot lead a browser here by a name of its own.
    """
    interface, page = describe(), LivePage(snapshots)
    files: dict[str, tuple[bytes | str, str]] = {
        **{f"/{name}": (page_file(name), _KINDS[Path(name).suffix]) for name in _NAMES.split()},
        "/": (live_page(), "text/html"),
        "/api": (api_page(interface), "text/html"),
        "/openapi.json": (json.dumps(interface), "application/json"),
    }
    endpoints = {name: _endpoint(partial(snapshots.answer, name), *_ASKED.get(name, ())) for name in ENDPOINTS}
    endpoints |= {"page": _endpoint(page.answer, Shown), "report": _endpoint(page.report, Shown)}
    routes = [Route(path, _page(*file)) for path, file in files.items()]
    routes += [Route(f"{API}/{name}", endpoint) for name, endpoint in endpoints.items()]
    middleware = [
        Middleware(_Guard, token=token),
        # No threads: what compression costs counts in the server's share of a core.
        Middleware(GZipMiddleware, minimum_size=1000, compresslevel=1, thread_minimum_size=sys.maxsize),
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


def _page(content: bytes | str, kind: str) -> Callable[[Request], Awaitable[Response]]:
    async def answer(_: Request) -> Response:
        return Response(content, media_type=kind)

    return answer


def _endpoint(make: Callable[..., Answer], *asked: type[BaseModel]) -> Callable[[Request], Awaitable[Response]]:
    """Answer with the tag; without the body where the reader has it already.  `make` gets what was asked for."""

    async def answer(request: Request) -> Response:
        try:
            made = make(*(kind.model_validate(dict(request.query_params)) for kind in asked))
        except ValidationError as error:
            (wrong, *_) = error.errors(include_url=False)
            return _error(400, f"{wrong['loc'][0]}: {wrong['msg']}")
        known = request.headers.get("if-none-match") == made.etag
        body, status = (None, 304) if known else (made.body, 200)
        return Response(body, status, {"ETag": made.etag}, None if known else made.kind)

    return answer


def describe() -> Schema:
    """Write the OpenAPI document (version 3.1) of the endpoints: from their docstrings, their parameters and their keys."""
    paths, schemas, empty = {}, dict(PARTS), Snapshots("")
    for name in ENDPOINTS:
        method, asked, schema = getattr(empty, name), _ASKED.get(name, ()), name.capitalize()
        keys = method(*(kind() for kind in asked))
        schemas[schema] = described({key: {**of, "description": says} for key, (_, of, says) in keys.items()})
        fields = [field for kind in asked for field in kind.model_json_schema()["properties"].items()]
        content = {"application/json": {"schema": part(schema)}}
        operation = {
            "summary": method.__doc__,
            "operationId": name,
            "parameters": [
                {"name": key, "in": "query", "description": of.pop("description"), "schema": of} for key, of in fields
            ],
            "responses": {"200": {"description": method.__doc__, "content": content}, **_REFUSALS},
        }
        paths[f"{API}/{name}"] = {"get": operation}
    return {
        "openapi": "3.1.0",
        "info": {"title": "shm-monitor", "version": __version__, "description": _ABOUT},
        "paths": paths,
        "components": {"schemas": schemas, "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
        "security": [{"token": []}, {}],
    }


async def _refusal(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _error(error.status_code, error.detail, error.headers)


def _error(status: int, text: str, headers: Any = None) -> Response:
    return JSONResponse({"error": text}, status, headers)
