from . import alarm, ground, stage
from .alarm import EventAlarm
from .event import Event, FloorMotion, Spectrum
from .ground import GroundState
from .limits import POSSIBLY, compared
from .review import FirstMode, Review, review_event
from .settings import EventSettings, LimitTable
from .site import Site
from .stage import EventState

__all__ = [
    "POSSIBLY",
    "Event",
    "EventAlarm",
    "EventSettings",
    "EventState",
    "FirstMode",
    "FloorMotion",
    "GroundState",
    "LimitTable",
    "Review",
    "Site",
    "Spectrum",
    "alarm",
    "compared",
    "ground",
    "review_event",
    "stage",
]
