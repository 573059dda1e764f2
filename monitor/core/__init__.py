"""Types and tools shared by all packages: results, errors, settings, files and a map over processes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
