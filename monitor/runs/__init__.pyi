from . import demo, diagnose, ledger, paper_tables, replay, synthetic_recording
from .archive.inventory import expand
from .archive.jobs import WINDOWS
from .archive.reprocess import reprocess
from .calibrate import calibrate
from .emulate import send_all
from .importers import import_files
from .recordings import Progress, duration_s
from .session import Session, SessionState, View, scene

__all__ = [
    "WINDOWS",
    "Progress",
    "Session",
    "SessionState",
    "View",
    "calibrate",
    "demo",
    "diagnose",
    "duration_s",
    "expand",
    "import_files",
    "ledger",
    "paper_tables",
    "replay",
    "reprocess",
    "scene",
    "send_all",
    "synthetic_recording",
]
