"""Diagnosis of a recording: stepwise selection of effects, ambiguity between them, gain on held-out data, wording."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
