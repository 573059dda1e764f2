"""Security check of a site file: unprotected access from other machines, and secrets that everyone may read."""

from __future__ import annotations

import ipaddress
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from monitor.config.configuration import Configuration


def warnings(path: Path, config: Configuration) -> list[str]:
    """List one warning for each setting of the site file `path` that gives unprotected access or exposes a secret."""
    found = []
    if (address := config.output.address) is not None and not is_loopback(address[0]):
        found.append(
            f"output.serve: the Rerun server at {config.output.serve} knows no password: all who reach it see all"
        )
    metrics = config.output.metrics or {}
    host = str(metrics.get("listen", "127.0.0.1:9464")).rpartition(":")[0]
    if not is_loopback(host) and "client_ca" not in metrics:
        found.append(f"output.metrics: all who reach {host} may read; set certificate, private_key and client_ca")
    if (web := config.output.web_address) is not None and not is_loopback(web[0]):
        risk = "the token and the results pass unencrypted; use SSH or a proxy with TLS"
        found.append(f"output.web: at {config.output.web} {risk}")
    for name, table in (("source", config.source), ("output.zenoh", config.output.zenoh)):
        for key, risk in (
            ("listen", "is open to the network without TLS: whoever reaches it may send and ask anything"),
            ("connect", "leaves this machine without TLS: data may be read and forged on the way"),
        ):
            endpoints = (e for e in _endpoints(table, key) if e.startswith("tcp/"))
            remote = (e for e in endpoints if not is_loopback(e[4:].rpartition(":")[0]))
            found += [f"{name}.{key}: {endpoint} {risk}" for endpoint in remote]
    for name, broker in _mqtt_tables(config).items():
        host = str(broker.get("host"))
        if not is_loopback(host) and not broker.get("tls"):
            found.append(f"{name}.host: {host} is reached without TLS: data and password may be read on the way")
    return found + _readable_secrets(path, config)


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host: ``localhost`` or a loopback address.

    Examples
    --------
    >>> is_loopback("[::1]"), is_loopback("localhost"), is_loopback("192.168.0.7")
    (True, True, False)
    """
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _endpoints(table: Mapping[str, Any] | None, key: str) -> list[str]:
    """List the Zenoh endpoints of a table; none if the table or the key is missing."""
    value = (table or {}).get(key, [])
    return [str(item) for item in value] if isinstance(value, list | tuple) else []


def _mqtt_tables(config: Configuration) -> dict[str, Mapping[str, Any]]:
    """Return the tables that name an MQTT broker, by their names."""
    source, out = config.source or {}, config.output.mqtt
    return ({"source": source} if source.get("kind") == "mqtt" else {}) | ({} if out is None else {"output.mqtt": out})


def _readable_secrets(path: Path, config: Configuration) -> list[str]:
    """Warn of files with secrets that every user of this machine may read."""
    files = {"notify.url_file": config.notify.get("url_file"), "output.web_token_file": config.output.web_token_file}
    files |= {f"{name}.password_file": table.get("password_file") for name, table in _mqtt_tables(config).items()}
    return [
        f"{key}: {name} can be read by everyone: chmod o-r"
        for key, name in files.items()
        if name is not None and _mode(path.resolve().parent / str(name)) & stat.S_IROTH
    ]


def _mode(path: Path) -> int:
    """Return the mode of a file; 0 if it cannot be asked for."""
    try:
        return path.stat().st_mode
    except OSError:
        return 0
