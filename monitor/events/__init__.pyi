from . import ground, stage
from .event import Event, FloorMotion, Spectrum
from .ground import GroundState
from .review import FirstMode, Review, review_event
from .settings import EventSettings, LimitTable
from .site import Site
from .stage import EventState

__all__ = [
    "Event",
    "EventSettings",
    "EventState",
    "FirstMode",
    "FloorMotion",
    "GroundState",
    "LimitTable",
    "Review",
    "Site",
    "Spectrum",
    "ground",
    "review_event",
    "stage",
]
