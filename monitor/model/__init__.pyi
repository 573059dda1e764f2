from . import prior_file as prior_file
from .effects import (
    CALIBRATION_EFFECTS as CALIBRATION_EFFECTS,
    EFFECTS as EFFECTS,
    FORMS as FORMS,
    Condition as Condition,
    Context as Context,
    Effect as Effect,
    EffectError as EffectError,
    ExtraMode as ExtraMode,
    FittedModel as FittedModel,
    FittedSizes as FittedSizes,
    LawFamily as LawFamily,
    LawKind as LawKind,
    Line as Line,
    Parameter as Parameter,
    ParameterEstimates as ParameterEstimates,
    Peak as Peak,
    System as System,
    interval as interval,
    locations as locations,
    parse_effect as parse_effect,
    place_index as place_index,
    story_damage as story_damage,
    unit as unit,
)
from .instrumented import InstrumentedModel as InstrumentedModel
from .integration import loaded as loaded, march as march
from .model import Model as Model, Modes as Modes
from .prior import (
    ModelDiscrepancy as ModelDiscrepancy,
    StructuralPrior as StructuralPrior,
    correction_basis as correction_basis,
    inverse as inverse,
    prior_from_drawing as prior_from_drawing,
)
from .simulation import (
    ExcitationKind as ExcitationKind,
    Motion as Motion,
    channel_motion as channel_motion,
    driven as driven,
    own_forces as own_forces,
    respond_newmark as respond_newmark,
    simulate as simulate,
    with_own_forces as with_own_forces,
)
from .structures import Building as Building, MatrixStructure as MatrixStructure, ShearFrame as ShearFrame
from .structures.drawing import (
    Drawing as Drawing,
    LineTable as LineTable,
    NodeTable as NodeTable,
    drawing_problems as drawing_problems,
)
from .structures.tables import (
    BuildingTable as BuildingTable,
    DrawnTable as DrawnTable,
    ModalTable as ModalTable,
    StoreyTable as StoreyTable,
    StructureTable as StructureTable,
)
