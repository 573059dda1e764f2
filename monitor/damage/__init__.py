"""Model updating of the story stiffnesses, damage index against the healthy baseline, and alarms."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
