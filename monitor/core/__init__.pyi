from .blas import single_blas_thread as single_blas_thread
from .bounded_queue import BoundedQueue as BoundedQueue, Full as Full
from .busy import Busy as Busy
from .codec import decode as decode, encode as encode, from_plain as from_plain, to_plain as to_plain
from .compilation import compiled as compiled
from .errors import (
    BadConfigurationError as BadConfigurationError,
    BadInputError as BadInputError,
    InUseError as InUseError,
    MissingInputError as MissingInputError,
    NoResourcesError as NoResourcesError,
    UserError as UserError,
    WrongUsageError as WrongUsageError,
    os_errors_of as os_errors_of,
)
from .extras import import_extra as import_extra, missing_extra as missing_extra, require_extra as require_extra
from .files import (
    demand_file as demand_file,
    demand_place as demand_place,
    finish as finish,
    no_empty_folder as no_empty_folder,
    partial as partial,
    set_aside as set_aside,
    sha256 as sha256,
    spare_inputs as spare_inputs,
    tail_lines as tail_lines,
    write_atomically as write_atomically,
)
from .memory import keep_freed as keep_freed
from .naming import (
    DIRECTION_WORDS as DIRECTION_WORDS,
    floor_name as floor_name,
    name_stories as name_stories,
    name_stories_in as name_stories_in,
    storey_of as storey_of,
    storey_words as storey_words,
    story_name as story_name,
    together as together,
)
from .optimization import levenberg_marquardt as levenberg_marquardt
from .parallel import parallel_map as parallel_map
from .parse import parse_address as parse_address, parse_json as parse_json, utc as utc, utc_ns as utc_ns
from .progress import OnProgress as OnProgress, Step as Step
from .recording_errors import read_by_user as read_by_user
from .results import (
    CLOCK as CLOCK,
    GAP as GAP,
    STILL as STILL,
    STRONG_MOTION as STRONG_MOTION,
    WHOLE as WHOLE,
    Alarm as Alarm,
    AlarmCondition as AlarmCondition,
    Array as Array,
    ComplexArray as ComplexArray,
    CrossSpectra as CrossSpectra,
    DamageReading as DamageReading,
    FeatureReading as FeatureReading,
    Gap as Gap,
    LagSums as LagSums,
    LeftOutChannel as LeftOutChannel,
    Level as Level,
    ModalEstimate as ModalEstimate,
    ModalReading as ModalReading,
    OtherMode as OtherMode,
    Reading as Reading,
    Samples as Samples,
    Skipped as Skipped,
    StiffnessEstimate as StiffnessEstimate,
    Temperature as Temperature,
    Window as Window,
    WindowResult as WindowResult,
)
from .rounding import rounded as rounded
from .settings import Settings as Settings, read_settings as read_settings, settings_problems as settings_problems
from .worker import (
    Retry as Retry,
    Work as Work,
    Worker as Worker,
)
