"""Events: strong motion of the whole structure is recognized, measured, and compared with the site's limits."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
