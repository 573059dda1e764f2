from . import alarm, damage_index
from .alarm import AlarmSettings, AlarmState, StoryState, hold
from .alternative_solutions import second_solutions
from .baseline import Baseline, learn_baseline
from .baseline_file import load_baseline, save_baseline
from .updating import Observation, Update, UpdatingSettings, observe, update

__all__ = [
    "AlarmSettings",
    "AlarmState",
    "Baseline",
    "Observation",
    "StoryState",
    "Update",
    "UpdatingSettings",
    "alarm",
    "damage_index",
    "hold",
    "learn_baseline",
    "load_baseline",
    "observe",
    "save_baseline",
    "second_solutions",
    "update",
]
