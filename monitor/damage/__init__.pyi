from . import alarm, damage_index, judge, slow_learning
from .alarm import AlarmSettings, AlarmState, StoryState, hold
from .alternative_solutions import second_solutions
from .assessment import (
    Assessment,
    Course,
    Known,
    Loss,
    State,
    WindowFacts,
    assess,
    diagnosis_of,
    follow,
    is_seen,
    outdated,
    unit_questions,
)
from .baseline import AnyBaseline, Baseline, ModalBaseline
from .baseline_file import load_baseline, load_modal_baseline, save_baseline
from .baseline_learning import learn_baseline, learn_modal_baseline, rebase_baseline
from .common_change import UNMEASURED, Expected
from .covariate_law import CovariateLaw
from .covariates import LEVEL, CovariateSettings, LearnedRange, common_words, law_lines, learned_ranges
from .detectable_loss import clock_error
from .feature_change import FeatureJudge, FeatureTable, FeatureVerdict, judge_features
from .judge import Memory
from .level import drift_m, level_db
from .modal_stiffness import ModalStiffness
from .origin import Origin
from .parts import modal_parts
from .quantities import Quantities, View
from .story_stiffness import StoryStiffness
from .updating import Observation, Update, UpdatingSettings, observe, update

__all__ = [
    "LEVEL",
    "UNMEASURED",
    "AlarmSettings",
    "AlarmState",
    "AnyBaseline",
    "Assessment",
    "Baseline",
    "Course",
    "CovariateLaw",
    "CovariateSettings",
    "Expected",
    "FeatureJudge",
    "FeatureTable",
    "FeatureVerdict",
    "Known",
    "LearnedRange",
    "Loss",
    "Memory",
    "ModalBaseline",
    "ModalStiffness",
    "Observation",
    "Origin",
    "Quantities",
    "State",
    "StoryState",
    "StoryStiffness",
    "Update",
    "UpdatingSettings",
    "View",
    "WindowFacts",
    "alarm",
    "assess",
    "clock_error",
    "common_words",
    "damage_index",
    "diagnosis_of",
    "drift_m",
    "follow",
    "hold",
    "is_seen",
    "judge",
    "judge_features",
    "law_lines",
    "learn_baseline",
    "learn_modal_baseline",
    "learned_ranges",
    "level_db",
    "load_baseline",
    "load_modal_baseline",
    "modal_parts",
    "observe",
    "outdated",
    "rebase_baseline",
    "save_baseline",
    "second_solutions",
    "slow_learning",
    "unit_questions",
    "update",
]
