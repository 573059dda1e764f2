"""Monitoring service: the daemon with its threads, restart, history and own health, and the outlets that publish results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
