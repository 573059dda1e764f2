from . import (
    calibrate,
    compare,
    demo,
    diagnose,
    features,
    ledger,
    ledger_chain,
    look,
    paper_tables,
    replay,
    synthetic_recording,
)
from .archive.inventory import expand_patterns
from .archive.jobs import WINDOWS
from .archive.reprocess import reprocess
from .baselines import load_healthy
from .emulate import send_all
from .event_page import page_of, read_event_line, read_event_page, write_event_motion, write_event_page
from .event_recordings import EventRecordings
from .importers import ImportedChannel, acceleration_unit, import_files
from .object_storage import local_copies
from .online_diagnosis import longest_diagnosis_s
from .recent_blocks import RecentBlocks
from .recordings import Progress, duration_s
from .session import Session, SessionState
from .synthetic_recording import cut_into_blocks, require_stable
from .viewer import open_viewer
from .warming import warm_up

__all__ = [
    "WINDOWS",
    "EventRecordings",
    "ImportedChannel",
    "Progress",
    "RecentBlocks",
    "Session",
    "SessionState",
    "acceleration_unit",
    "calibrate",
    "compare",
    "cut_into_blocks",
    "demo",
    "diagnose",
    "duration_s",
    "expand_patterns",
    "features",
    "import_files",
    "ledger",
    "ledger_chain",
    "load_healthy",
    "local_copies",
    "longest_diagnosis_s",
    "look",
    "open_viewer",
    "page_of",
    "paper_tables",
    "read_event_line",
    "read_event_page",
    "replay",
    "reprocess",
    "require_stable",
    "send_all",
    "synthetic_recording",
    "warm_up",
    "write_event_motion",
    "write_event_page",
]
