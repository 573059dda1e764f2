from . import ground, stage
from .event import Event, FloorMotion
from .ground import GroundState
from .settings import EventSettings
from .site import Site
from .stage import EventState

__all__ = [
    "Event",
    "EventSettings",
    "EventState",
    "FloorMotion",
    "GroundState",
    "Site",
    "ground",
    "stage",
]
