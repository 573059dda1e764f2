from .causes import Cause as Cause, Diagnosis as Diagnosis, diagnose as diagnose
from .extending import (
    Condition as Condition,
    Context as Context,
    Effect as Effect,
    FittedSizes as FittedSizes,
    Parameter as Parameter,
    UserError as UserError,
    add_effect as add_effect,
)
from .modes import Modes as Modes, identify as identify
from .recording import Recording as Recording, read as read
from .simulation import simulate as simulate
from .structures import Structure as Structure, structure as structure
from .updating import Updated as Updated, update as update
