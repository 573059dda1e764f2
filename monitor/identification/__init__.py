"""Identification of a window's modes (stochastic subspace identification, refinement) and tracking of modes over time."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
