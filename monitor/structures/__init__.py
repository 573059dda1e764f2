"""Structures by the name that a structure file's ``kind`` gives."""

from monitor.structures.shear_frame import ShearFrame

STRUCTURES = {"shear_frame": ShearFrame}

__all__ = ["STRUCTURES", "ShearFrame"]
