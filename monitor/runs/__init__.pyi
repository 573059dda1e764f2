from . import (
    calibrate as calibrate,
    compare as compare,
    demo as demo,
    diagnose as diagnose,
    features as features,
    ledger as ledger,
    ledger_chain as ledger_chain,
    look as look,
    paper_tables as paper_tables,
    replay as replay,
    synthetic_recording as synthetic_recording,
)
from .archive.inventory import expand_patterns as expand_patterns
from .archive.jobs import WINDOWS as WINDOWS
from .archive.reprocess import reprocess as reprocess
from .baselines import load_healthy as load_healthy
from .emulate import send_all as send_all
from .event_page import (
    page_of as page_of,
    read_event_line as read_event_line,
    read_event_page as read_event_page,
    write_event_motion as write_event_motion,
    write_event_page as write_event_page,
)
from .event_recordings import EventRecordings as EventRecordings
from .exports.dataset import site_folders as site_folders, write_dataset as write_dataset
from .exports.export import channels_of as channels_of, export as export, form_of as form_of
from .object_storage import local_copies as local_copies
from .online_diagnosis import longest_diagnosis_s as longest_diagnosis_s
from .readers import (
    ImportedChannel as ImportedChannel,
    Options as Options,
    acceleration_unit as acceleration_unit,
    as_recordings as as_recordings,
    explain_table as explain_table,
    import_files as import_files,
    zone_named as zone_named,
)
from .recent_blocks import RecentBlocks as RecentBlocks
from .recordings import Progress as Progress, duration_s as duration_s
from .session import Session as Session, SessionState as SessionState
from .synthetic_recording import cut_into_blocks as cut_into_blocks, require_stable as require_stable
from .viewer import open_viewer as open_viewer
from .warming import warm_up as warm_up
