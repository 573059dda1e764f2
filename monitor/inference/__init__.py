"""Inference: cross-spectra of a recording, the posterior of a model's parameters, and the most probable parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
