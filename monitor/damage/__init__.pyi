from . import alarm, damage_index, slow_learning
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
    facts_of,
    follow,
    is_seen,
    outdated,
    utc,
)
from .baseline import Baseline, learn_baseline, rebase_baseline
from .baseline_file import load_baseline, save_baseline
from .covariate_law import CovariateLaw, Effect
from .covariates import LEVEL, CovariateSettings, LearnedRange, beyond_words, law_lines, learned_ranges
from .detectable_loss import smallest_detectable_loss
from .feature_test import FeatureJudge, FeatureTable, FeatureVerdict, judge_features
from .level import drift_m, drift_weights, level_db
from .origin import Origin
from .updating import Observation, Update, UpdatingSettings, observe, update

__all__ = [
    "LEVEL",
    "AlarmSettings",
    "AlarmState",
    "Assessment",
    "Baseline",
    "Course",
    "CovariateLaw",
    "CovariateSettings",
    "Effect",
    "FeatureJudge",
    "FeatureTable",
    "FeatureVerdict",
    "Known",
    "LearnedRange",
    "Loss",
    "Observation",
    "Origin",
    "State",
    "StoryState",
    "Update",
    "UpdatingSettings",
    "WindowFacts",
    "alarm",
    "assess",
    "beyond_words",
    "damage_index",
    "diagnosis_of",
    "drift_m",
    "drift_weights",
    "facts_of",
    "follow",
    "hold",
    "is_seen",
    "judge_features",
    "law_lines",
    "learn_baseline",
    "learned_ranges",
    "level_db",
    "load_baseline",
    "observe",
    "outdated",
    "rebase_baseline",
    "save_baseline",
    "second_solutions",
    "slow_learning",
    "smallest_detectable_loss",
    "update",
    "utc",
]
