from . import prior_file
from .effects import (
    CALIBRATION_EFFECTS,
    EFFECTS,
    FORMS,
    Condition,
    Context,
    Effect,
    EffectError,
    FittedModel,
    FittedSizes,
    LawKind,
    ParameterEstimates,
    System,
    interval,
    locations,
    parse_effect,
    story_damage,
    unit,
)
from .instrumented import InstrumentedModel
from .integration import loaded, march
from .model import Model, Modes
from .prior import ModelDiscrepancy, StructuralPrior, correction_basis, inverse, prior_from_drawing
from .simulation import ExcitationKind, Motion, respond, respond_newmark, simulate
from .structures import MatrixStructure, ShearFrame
from .structures.drawing import Drawing, LineTable, NodeTable, drawing_problems
from .structures.tables import Matrix, Positive, StructureTable

__all__ = [
    "CALIBRATION_EFFECTS",
    "EFFECTS",
    "FORMS",
    "Condition",
    "Context",
    "Drawing",
    "Effect",
    "EffectError",
    "ExcitationKind",
    "FittedModel",
    "FittedSizes",
    "InstrumentedModel",
    "LawKind",
    "LineTable",
    "Matrix",
    "MatrixStructure",
    "Model",
    "ModelDiscrepancy",
    "Modes",
    "Motion",
    "NodeTable",
    "ParameterEstimates",
    "Positive",
    "ShearFrame",
    "StructuralPrior",
    "StructureTable",
    "System",
    "correction_basis",
    "drawing_problems",
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
    "story_damage",
    "unit",
]
