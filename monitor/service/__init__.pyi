from . import export, fleet, logs, outlets, status
from .daemon import Daemon
from .fleet_view import FleetView, text
from .outlets.zenoh import ZenohOutSettings, ask, key_prefix
from .requests import Request

__all__ = [
    "Daemon",
    "FleetView",
    "Request",
    "ZenohOutSettings",
    "ask",
    "export",
    "fleet",
    "key_prefix",
    "logs",
    "outlets",
    "status",
    "text",
]
