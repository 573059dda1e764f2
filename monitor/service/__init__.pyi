from . import dataset as dataset, export as export, fleet as fleet, logs as logs, outlets as outlets, status as status
from .fleet_html import fleet_page as fleet_page
from .fleet_view import FleetView as FleetView, text as text
from .host_worker import is_of_share as is_of_share
from .host_workers import HostWorkers as HostWorkers
from .outlets.inbox import leave_request as leave_request, take_refusal as take_refusal
from .outlets.zenoh import ZenohOutSettings as ZenohOutSettings, ask as ask, key_prefix as key_prefix
from .requests import Request as Request
from .supervisor import ALONE as ALONE, Host as Host, Policy as Policy
