"""Structures: how masses and stiffnesses make matrices.  One file a kind; `tables` reads them from TOML."""

from monitor.model.structures.base import Structure
from monitor.model.structures.matrices import MatrixStructure
from monitor.model.structures.shear_frame import ShearFrame

__all__ = ["MatrixStructure", "ShearFrame", "Structure"]
