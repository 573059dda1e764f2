"""The daemon: threads, restart, history, its own health, and the outlets that others hear it by."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
