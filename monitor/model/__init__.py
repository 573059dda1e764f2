"""The simulation: Model = structure + effects, its motion in time, and what is known of it beforehand."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
