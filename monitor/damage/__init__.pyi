from . import alarm, baseline, damage_index
from .alarm import AlarmSettings, AlarmState, StoryState, hold
from .alternative_solutions import second_solutions
from .baseline import Baseline, learn, load, save
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
    "baseline",
    "damage_index",
    "hold",
    "learn",
    "load",
    "observe",
    "save",
    "second_solutions",
    "update",
]
