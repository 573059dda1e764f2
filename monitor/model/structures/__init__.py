"""Kinds of structure: mass and stiffness matrices from masses and stiffnesses.

Each kind has a file of its own; `tables` reads their parameters from TOML.
"""

from monitor.model.structures.base import Structure
from monitor.model.structures.building import Building
from monitor.model.structures.condensation import condense_massless
from monitor.model.structures.matrices import MatrixStructure
from monitor.model.structures.shear_frame import ShearFrame

__all__ = ["Building", "MatrixStructure", "ShearFrame", "Structure", "condense_massless"]
