"""Structures: how masses and stiffnesses make matrices.  One file a kind; `tables` reads them from TOML."""

from monitor.structures.base import Structure
from monitor.structures.matrices import MatrixStructure
from monitor.structures.shear_frame import ShearFrame

__all__ = ["MatrixStructure", "ShearFrame", "Structure"]
