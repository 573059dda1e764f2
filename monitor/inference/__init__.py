"""How probable a model is given a recording: cross-spectra, posterior, most probable parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
