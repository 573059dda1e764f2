from .blas import single_blas_thread
from .busy import Busy
from .compilation import compiled
from .errors import (
    BadConfigurationError,
    BadInputError,
    MissingInputError,
    NoResourcesError,
    UserError,
    WrongUsageError,
)
from .extras import import_extra, missing_extra, require_extra
from .files import demand_place, finish, partial, set_aside, sha256, spare_inputs, write_atomically
from .memory import keep_freed
from .naming import name_stories, name_stories_in
from .optimization import levenberg_marquardt
from .parallel import parallel_map
from .parse import parse_address, parse_json, utc_ns
from .results import (
    GAP,
    WHOLE,
    Alarm,
    AlarmCondition,
    Array,
    ComplexArray,
    DamageReading,
    Gap,
    LagSums,
    LeftOutChannel,
    Level,
    ModalEstimate,
    ModalReading,
    OtherMode,
    Samples,
    Skipped,
    StiffnessEstimate,
    Temperature,
    Window,
    WindowResult,
)
from .settings import Settings, read_settings, settings_problems

__all__ = [
    "GAP",
    "WHOLE",
    "Alarm",
    "AlarmCondition",
    "Array",
    "BadConfigurationError",
    "BadInputError",
    "Busy",
    "ComplexArray",
    "DamageReading",
    "Gap",
    "LagSums",
    "LeftOutChannel",
    "Level",
    "MissingInputError",
    "ModalEstimate",
    "ModalReading",
    "NoResourcesError",
    "OtherMode",
    "Samples",
    "Settings",
    "Skipped",
    "StiffnessEstimate",
    "Temperature",
    "UserError",
    "Window",
    "WindowResult",
    "WrongUsageError",
    "compiled",
    "demand_place",
    "finish",
    "import_extra",
    "keep_freed",
    "levenberg_marquardt",
    "missing_extra",
    "name_stories",
    "name_stories_in",
    "parallel_map",
    "parse_address",
    "parse_json",
    "partial",
    "read_settings",
    "require_extra",
    "set_aside",
    "settings_problems",
    "sha256",
    "single_blas_thread",
    "spare_inputs",
    "utc_ns",
    "write_atomically",
]
