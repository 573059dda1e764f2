from . import dataset, export, fleet, logs, outlets, status
from .daemon import Daemon
from .fleet_html import fleet_page
from .fleet_view import FleetView, text
from .host import Host, is_of_share
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
    "dataset",
    "export",
    "fleet",
    "fleet_page",
    "is_of_share",
    "key_prefix",
    "leave_request",
    "logs",
    "outlets",
    "status",
    "text",
]
