from . import alarm as alarm, ground as ground, stage as stage
from .alarm import EventAlarm as EventAlarm
from .event import Event as Event, FloorMotion as FloorMotion, Spectrum as Spectrum
from .ground import GroundState as GroundState
from .limits import POSSIBLY as POSSIBLY, compared as compared
from .review import Review as Review, review_event as review_event
from .settings import EventSettings as EventSettings, LimitTable as LimitTable
from .site import Site as Site
from .stage import EventState as EventState
