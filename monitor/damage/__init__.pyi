from . import alarm, damage_index
from .alarm import AlarmSettings, AlarmState, StoryState, hold
from .alternative_solutions import second_solutions
from .assessment import (
    Assessment,
    Course,
    Known,
    Loss,
    State,
    WindowFacts,
    assess,
    diagnosis_of,
    facts_of,
    follow,
    is_seen,
    outdated,
    utc,
)
from .baseline import Baseline, learn_baseline, rebase_baseline
from .baseline_file import load_baseline, save_baseline
from .detectable_loss import smallest_detectable_loss
from .origin import Origin
from .updating import Observation, Update, UpdatingSettings, observe, update

__all__ = [
    "AlarmSettings",
    "AlarmState",
    "Assessment",
    "Baseline",
    "Course",
    "Known",
    "Loss",
    "Observation",
    "Origin",
    "State",
    "StoryState",
    "Update",
    "UpdatingSettings",
    "WindowFacts",
    "alarm",
    "assess",
    "damage_index",
    "diagnosis_of",
    "facts_of",
    "follow",
    "hold",
    "is_seen",
    "learn_baseline",
    "load_baseline",
    "observe",
    "outdated",
    "rebase_baseline",
    "save_baseline",
    "second_solutions",
    "smallest_detectable_loss",
    "update",
    "utc",
]
