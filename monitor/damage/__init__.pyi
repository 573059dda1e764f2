from . import alarm as alarm, damage_index as damage_index, judge as judge, slow_learning as slow_learning
from .alarm import AlarmSettings as AlarmSettings, AlarmState as AlarmState, StoryState as StoryState, hold as hold
from .alternative_solutions import second_solutions as second_solutions
from .assessment import (
    Assessment as Assessment,
    Course as Course,
    Known as Known,
    Loss as Loss,
    State as State,
    WindowFacts as WindowFacts,
    assess as assess,
    diagnosis_of as diagnosis_of,
    follow as follow,
    is_seen as is_seen,
    outdated as outdated,
    unit_questions as unit_questions,
)
from .baseline import AnyBaseline as AnyBaseline, Baseline as Baseline, ModalBaseline as ModalBaseline
from .baseline_file import (
    load_baseline as load_baseline,
    load_modal_baseline as load_modal_baseline,
    save_baseline as save_baseline,
)
from .baseline_learning import (
    HealthyData as HealthyData,
    learn_baseline as learn_baseline,
    learn_modal_baseline as learn_modal_baseline,
    rebase_baseline as rebase_baseline,
)
from .common_change import UNMEASURED as UNMEASURED, Expected as Expected
from .covariate_law import CovariateLaw as CovariateLaw
from .covariates import (
    LEVEL as LEVEL,
    CovariateSettings as CovariateSettings,
    LearnedRange as LearnedRange,
    common_words as common_words,
    law_lines as law_lines,
    learned_ranges as learned_ranges,
)
from .detectable_loss import clock_error as clock_error, smallest_detectable_loss as smallest_detectable_loss
from .feature_change import (
    FALSE_ANNOUNCEMENTS_PER_YEAR as FALSE_ANNOUNCEMENTS_PER_YEAR,
    FeatureJudge as FeatureJudge,
    FeatureTable as FeatureTable,
    judge_features as judge_features,
)
from .foreseen import what_sensors_see as what_sensors_see
from .healthy_series import LAGS_H as LAGS_H, FeatureModel as FeatureModel
from .judge import Memory as Memory
from .level import drift_m as drift_m, level_db as level_db
from .modal_stiffness import ModalStiffness as ModalStiffness
from .origin import Origin as Origin
from .parts import (
    ALONE as ALONE,
    TOGETHER as TOGETHER,
    Features as Features,
    Parts as Parts,
    located as located,
    modal_parts as modal_parts,
)
from .presence import Presence as Presence, Sighting as Sighting, learn_presence as learn_presence
from .quantities import Quantities as Quantities, View as View
from .spectrum import HealthySpectrum as HealthySpectrum, learn_spectrum as learn_spectrum
from .story_stiffness import StoryStiffness as StoryStiffness
from .updating import (
    Observation as Observation,
    Update as Update,
    UpdatingSettings as UpdatingSettings,
    observe as observe,
    update as update,
)
from .what_to_do import advice as advice
