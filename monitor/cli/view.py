"""Command `view`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from typer import Argument, Exit, Option

from monitor.cli.common import warn
from monitor.core import MissingInputError, WrongUsageError, parse_address, require_extra

_LOOPBACK, _PORT = "127.0.0.1", 9090
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def view(
    what: Annotated[
        str,
        Argument(
            metavar="DIR|FILE.rrd|HOST:PORT", help="Folder of results, a recording, or the address of [output] serve."
        ),
    ],
    web: Annotated[bool, Option("--web", help="Use a browser: print the address, serve until interrupted.")] = False,
    bind: Annotated[
        str | None, Option(metavar="ADDRESS", help=f"Address of --web, {_LOOPBACK} by default; there is no password.")
    ] = None,
    port: Annotated[
        int | None, Option(min=0, max=65535, help=f"Port of the page of --web, {_PORT} by default; 0: any free one.")
    ] = None,
) -> None:
    """Show a run in the Rerun viewer, or with --web in a browser."""
    if not web and (bind is not None or port is not None):
        raise WrongUsageError("--bind and --port go with --web")
    source, program = _viewer_source(what), _viewer_program()
    if not web and sys.platform == "linux" and not any(os.environ.get(name) for name in _SCREENS):
        unset = f"{', '.join(_SCREENS)} are not set"
        raise WrongUsageError(f"{what}: no screen here ({unset}); see it in a browser with --web")
    subprocess.run([program, "analytics", "disable"], capture_output=True, check=False)
    if not web:
        # By default the viewer would accept data from whoever reaches port 9876, and pass `source` to a daemon that serves there.
        os.environ["RUST_LOG"] = "error"
        os.execv(program, [program, source, "--bind", _LOOPBACK, "--port", "auto"])
    bind, port = _LOOPBACK if bind is None else bind, _PORT if port is None else port
    if bind != _LOOPBACK:
        warn(f"whoever reaches {bind} can see this; prefer an SSH tunnel to {_LOOPBACK}")
    page, data = _free_ports(bind, port, 0)
    data_url = source if "://" in source else f"rerun+http://{_reachable(bind)}:{data}/proxy"
    command = [program, "--serve-web", "--bind", bind, "--web-viewer-port", str(page), "--port", str(data)]
    if data_url != source:
        command.append(source)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as server:
        # Our colours are chosen for the dark theme.
        print(f"http://{_reachable(bind)}:{page}/?url={quote(data_url, safe='')}&theme=dark", flush=True)
        for number in (signal.SIGTERM, signal.SIGINT):  # a shell's background job begins with SIGINT ignored
            signal.signal(number, signal.default_int_handler)
        try:
            errors = server.communicate()[1]
        except KeyboardInterrupt:
            server.terminate()
            return
    if server.returncode > 0:
        print(errors, file=sys.stderr)
        raise Exit(1)


def _viewer_source(what: str) -> str:
    """Return the URL or the file that the viewer is to open."""
    with suppress(ValueError):
        parse_address(what)
        return f"rerun+http://{what}/proxy"
    path = Path(what) / "live.rrd" if Path(what).is_dir() else Path(what)
    if not path.is_file():
        remedy = "'replay --out DIR' leaves one, a daemon serves at [output] serve"
        raise MissingInputError(f"{path}: no such recording; {remedy}")
    return str(path)


def _viewer_program() -> str:
    """Return the path of the viewer's executable; its Python wrapper, when it is ended, would leave the viewer running."""
    require_extra("viewer", "view")
    spec = find_spec("rerun_cli")
    assert spec is not None
    assert spec.origin is not None
    return str(Path(spec.origin).parent / "rerun")


def _free_ports(address: str, *ports: int) -> list[int]:
    """Return the ports if they are free, or for each 0 any free port that is none of the others."""
    with ExitStack() as probes:  # all at once: a port that was let go may be found again
        found = []
        for port in ports:
            try:
                probe = probes.enter_context(socket.create_server((address, port)))
            except OSError as error:
                problem = f"{address}:{port}: {error.strerror or error}"
                raise MissingInputError(f"{problem}; give another --bind or --port") from error
            found.append(int(probe.getsockname()[1]))
        return found


def _reachable(bind: str) -> str:
    """Return an address under which this machine reaches a server bound to `bind`."""
    return _LOOPBACK if bind in ("0.0.0.0", "::") else bind
