from . import export, fleet, logs, outlets, status
from .daemon import Daemon
from .fleet_view import FleetView, text
from .host import Host
from .host_workers import HostWorkers
from .outlets.inbox import leave_request
from .outlets.zenoh import ZenohOutSettings, ask, key_prefix
from .requests import Request

__all__ = [
    "Daemon",
    "FleetView",
    "Host",
    "HostWorkers",
    "Request",
    "ZenohOutSettings",
    "ask",
    "export",
    "fleet",
    "key_prefix",
    "leave_request",
    "logs",
    "outlets",
    "status",
    "text",
]
