from .causes import Cause, Diagnosis, diagnose
from .extending import Condition, Context, Effect, FittedSizes, Parameter, UserError, add_effect
from .modes import Modes, identify
from .recording import Recording, read
from .simulation import simulate
from .structures import Structure, structure
from .updating import Updated, update

__all__ = [
    "Cause",
    "Condition",
    "Context",
    "Diagnosis",
    "Effect",
    "FittedSizes",
    "Modes",
    "Parameter",
    "Recording",
    "Structure",
    "Updated",
    "UserError",
    "add_effect",
    "diagnose",
    "identify",
    "read",
    "simulate",
    "structure",
    "update",
]
