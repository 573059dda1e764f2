from . import prior_file
from .effects import (
    EFFECTS,
    FORMS,
    AmbientForces,
    Condition,
    Context,
    Effect,
    EffectError,
    FittedSizes,
    LawKind,
    ParameterEstimates,
    StiffnessChange,
    System,
    interval,
    locations,
    parse_effect,
    unit,
)
from .effects.attached_oscillator import AttachedOscillator
from .effects.cubic_stiffness import CubicStiffness
from .effects.joint_flexibility import JointFlexibility
from .instrumented import InstrumentedModel
from .integration import loaded, march
from .model import Model, Modes
from .prior import ModelDiscrepancy, StructuralPrior, correction_basis, inverse, prior_from_drawing
from .simulation import ExcitationKind, Motion, respond, respond_newmark, simulate
from .structures import MatrixStructure, ShearFrame
from .structures.tables import Matrix, Positive, StructureTable

__all__ = [
    "EFFECTS",
    "FORMS",
    "AmbientForces",
    "AttachedOscillator",
    "Condition",
    "Context",
    "CubicStiffness",
    "Effect",
    "EffectError",
    "ExcitationKind",
    "FittedSizes",
    "InstrumentedModel",
    "JointFlexibility",
    "LawKind",
    "Matrix",
    "MatrixStructure",
    "Model",
    "ModelDiscrepancy",
    "Modes",
    "Motion",
    "ParameterEstimates",
    "Positive",
    "ShearFrame",
    "StiffnessChange",
    "StructuralPrior",
    "StructureTable",
    "System",
    "correction_basis",
    "interval",
    "inverse",
    "loaded",
    "locations",
    "march",
    "parse_effect",
    "prior_file",
    "prior_from_drawing",
    "respond",
    "respond_newmark",
    "simulate",
    "unit",
]
