from . import calibrate, demo, diagnose, features, ledger, ledger_chain, paper_tables, replay, synthetic_recording
from .archive.inventory import expand_patterns
from .archive.jobs import WINDOWS
from .archive.reprocess import reprocess
from .baselines import load_healthy
from .emulate import send_all
from .event_recordings import EventRecordings
from .importers import import_files
from .modal_calibration import calibrate_modes
from .recordings import Progress, duration_s
from .session import Session, SessionState
from .viewer import open_viewer
from .warming import warm_up

__all__ = [
    "WINDOWS",
    "EventRecordings",
    "Progress",
    "Session",
    "SessionState",
    "calibrate",
    "calibrate_modes",
    "demo",
    "diagnose",
    "duration_s",
    "expand_patterns",
    "features",
    "import_files",
    "ledger",
    "ledger_chain",
    "load_healthy",
    "open_viewer",
    "paper_tables",
    "replay",
    "reprocess",
    "send_all",
    "synthetic_recording",
    "warm_up",
]
