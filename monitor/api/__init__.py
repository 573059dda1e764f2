"""The library ``import shm_monitor as shm``: arrays in, frozen results with their uncertainty out; no files, no clocks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
