from .base import Publisher as Publisher
from .page.sheet import (
    Sheet as Sheet,
    api_page as api_page,
    live_page as live_page,
    one_file as one_file,
    page_file as page_file,
)
from .reports.diagnosis_report import write_report as write_report
from .reports.event_report import EventPage as EventPage, write_event as write_event
from .reports.live import live_sheet as live_sheet
from .reports.look_data import (
    G_M_S2 as G_M_S2,
    LookedBand as LookedBand,
    LookedMode as LookedMode,
    LookedRecording as LookedRecording,
)
from .reports.look_page import (
    doubtful_rows as doubtful_rows,
    mode_rows as mode_rows,
    peaks_in_words as peaks_in_words,
    write_look as write_look,
)
from .reports.period_notes import read_summary as read_summary
from .reports.period_report import read_period as read_period, write_period as write_period
from .results.arrow_table import WINDOWS_SCHEMA as WINDOWS_SCHEMA, windows_table as windows_table
from .results.event_lines import (
    EVENTS as EVENTS,
    event_line as event_line,
    event_text as event_text,
    last_told as last_told,
    read_event as read_event,
    telling as telling,
)
from .results.files import (
    closed_files as closed_files,
    month_file as month_file,
    pack_month as pack_month,
    read_lines as read_lines,
)
from .results.lines import (
    LinesFile as LinesFile,
    alarm_line as alarm_line,
    current_alarm_line as current_alarm_line,
    facts_of_line as facts_of_line,
    read_line as read_line,
    replay_text as replay_text,
    to_json as to_json,
)
from .results.recorded_time import (
    between_recordings as between_recordings,
    reaches_between as reaches_between,
    recorded_stretches as recorded_stretches,
)
from .results.summary import Quality as Quality, Summary as Summary, episode_content as episode_content
from .results.tables import (
    ITEMS as ITEMS,
    TABLES as TABLES,
    TABLES_VERSION as TABLES_VERSION,
    UPGRADES as UPGRADES,
    Row as Row,
    alarm_row as alarm_row,
    compact as compact,
    insert as insert,
    make_tables as make_tables,
    window_row as window_row,
)
from .results.window_fields import (
    KEPT as KEPT,
    LINE_SCHEMA as LINE_SCHEMA,
    SHOWN as SHOWN,
    Kind as Kind,
    window_line as window_line,
)
from .viewer.diagnosis_view import write_view as write_view
from .viewer.event_motion import write_motion as write_motion
from .viewer.output import Output as Output
from .viewer.publisher import RerunPublisher as RerunPublisher
from .viewer.scene import Scene as Scene, feature_scene as feature_scene, make_scene as make_scene
