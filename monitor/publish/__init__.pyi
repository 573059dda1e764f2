from .base import Publisher
from .reports.diagnosis_report import write_report
from .reports.event_report import EventPage, write_event
from .reports.look_data import G_M_S2, LookedBand, LookedMode, LookedRecording
from .reports.look_page import mode_rows, write_look
from .reports.period_report import read_period, write_period
from .results.arrow_table import WINDOWS_SCHEMA, windows_table
from .results.event_lines import EVENTS, event_line, event_text, last_told, read_event, telling
from .results.files import closed_files, month_file, pack_month, read_lines
from .results.lines import (
    LinesFile,
    alarm_line,
    current_alarm_line,
    facts_of_line,
    read_line,
    replay_text,
    to_json,
)
from .results.recorded_time import between_recordings, reaches_between, recorded_stretches
from .results.summary import Quality, Summary, episode_content
from .results.window_fields import KEPT, LINE_SCHEMA, SHOWN, Kind, window_line
from .viewer.diagnosis_view import write_view
from .viewer.event_motion import write_motion
from .viewer.output import Output
from .viewer.publisher import RerunPublisher
from .viewer.scene import make_scene

__all__ = [
    "EVENTS",
    "G_M_S2",
    "KEPT",
    "LINE_SCHEMA",
    "SHOWN",
    "WINDOWS_SCHEMA",
    "EventPage",
    "Kind",
    "LinesFile",
    "LookedBand",
    "LookedMode",
    "LookedRecording",
    "Output",
    "Publisher",
    "Quality",
    "RerunPublisher",
    "Summary",
    "alarm_line",
    "between_recordings",
    "closed_files",
    "current_alarm_line",
    "episode_content",
    "event_line",
    "event_text",
    "facts_of_line",
    "last_told",
    "make_scene",
    "mode_rows",
    "month_file",
    "pack_month",
    "reaches_between",
    "read_event",
    "read_line",
    "read_lines",
    "read_period",
    "recorded_stretches",
    "replay_text",
    "telling",
    "to_json",
    "window_line",
    "windows_table",
    "write_event",
    "write_look",
    "write_motion",
    "write_period",
    "write_report",
    "write_view",
]
