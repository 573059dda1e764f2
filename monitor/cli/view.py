"""The command `view`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer

from monitor.cli.common import warn
from monitor.core import MissingInputError, WrongUsageError, parse_address

_LOOPBACK, _PORT = "127.0.0.1", 9090
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def view(
    what: Annotated[
        str, typer.Argument(metavar="DIR|FILE.rrd|HOST:PORT", help="Results, a recording, or [output] serve.")
    ],
    web: Annotated[
        bool, typer.Option("--web", help="In a browser: says the address, serves until interrupted.")
    ] = False,
    bind: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help=f"Where --web listens, {_LOOPBACK} by default; there is no password."),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help=f"Of the page, for --web, {_PORT} by default; 0 takes a free one."),
    ] = None,
) -> None:
    """Show a run in the Rerun viewer, or with --web in a browser."""
    if not web and (bind is not None or port is not None):
        raise WrongUsageError("--bind and --port go with --web")
    source, program = _source(what), _program()
    if not web and sys.platform == "linux" and not any(os.environ.get(name) for name in _SCREENS):
        raise WrongUsageError(
            f"{what}: no screen here ({', '.join(_SCREENS)} are not set); see it in a browser with --web"
        )
    subprocess.run([program, "analytics", "disable"], capture_output=True, check=False)
    if not web:
        # By itself the viewer would take data from whoever reaches port 9876, and hand `source` to a daemon that serves there.
        os.environ["RUST_LOG"] = "error"
        os.execv(program, [program, source, "--bind", _LOOPBACK, "--port", "auto"])
    bind, port = _LOOPBACK if bind is None else bind, _PORT if port is None else port
    if bind != _LOOPBACK:
        warn(f"whoever reaches {bind} can see this; prefer an SSH tunnel to {_LOOPBACK}")
    page, data = _free(bind, port), _free(bind, 0)
    shown = source if "://" in source else f"rerun+http://{_reachable(bind)}:{data}/proxy"
    command = [program, "--serve-web", "--bind", bind, "--web-viewer-port", str(page), "--port", str(data)]
    if shown != source:
        command.append(source)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as server:
        print(
            f"http://{_reachable(bind)}:{page}/?url={quote(shown, safe='')}&theme=dark", flush=True
        )  # as are our colours
        for number in (signal.SIGTERM, signal.SIGINT):  # a shell's background job begins with SIGINT ignored
            signal.signal(number, signal.default_int_handler)
        try:
            said = server.communicate()[1]
        except KeyboardInterrupt:
            server.terminate()
            return
    if server.returncode > 0:
        print(said, file=sys.stderr)
        raise typer.Exit(1)


def _source(what: str) -> str:
    """What the viewer is to open.

    Raises
    ------
    MissingInputError
        There is no such thing.
    """
    with suppress(ValueError):
        parse_address(what)
        return f"rerun+http://{what}/proxy"
    path = Path(what) / "live.rrd" if Path(what).is_dir() else Path(what)
    if not path.is_file():
        raise MissingInputError(
            f"{path}: no such recording; 'replay --out DIR' leaves one, a daemon serves at [output] serve"
        )
    return str(path)


def _program() -> str:
    """The viewer itself: its wrapper, ended, would leave it running."""
    spec = find_spec("rerun_cli")
    path = Path(spec.origin).parent / "rerun" if spec and spec.origin else Path("rerun")
    if not path.exists():
        raise MissingInputError(f"{path}: the viewer is not installed; it comes with rerun-sdk")
    return str(path)


def _free(address: str, port: int) -> int:
    """The port, or a free one for 0."""
    try:
        with socket.create_server((address, port)) as probe:
            return int(probe.getsockname()[1])
    except OSError as error:
        raise MissingInputError(
            f"{address}:{port}: {error.strerror or error}; give another --bind or --port"
        ) from error


def _reachable(bind: str) -> str:
    return _LOOPBACK if bind in ("0.0.0.0", "::") else bind
