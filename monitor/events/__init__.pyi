from . import ground, stage
from .event import Event, FloorMotion, Spectrum
from .ground import GroundState
from .settings import EventSettings, LimitTable
from .site import Site
from .stage import EventState

__all__ = [
    "Event",
    "EventSettings",
    "EventState",
    "FloorMotion",
    "GroundState",
    "LimitTable",
    "Site",
    "Spectrum",
    "ground",
    "stage",
]
