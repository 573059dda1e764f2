from . import healthy_prior, trigger
from .clock_drift import ClockDrift, clock_drift_in_words, correct_clock_drifts, state_clock_drifts
from .cross_validation import HeldOutGain, confirm_on_held_out
from .damage_index_effect import ddi_effect
from .detectable_loss import detectable_losses
from .drawing_refit import other_optima, refit, withdraw_other_structure
from .files import content, effects_text, model_from_plain, model_to_plain, standing_causes, structure_text
from .fold_refit import fitted_model
from .initial_fit import FAR
from .lack_of_fit import residual_bands
from .observed_causes import add_observed_causes
from .parameter_uncertainty import is_significant
from .predictive_score import Score, score
from .score_test import parameter_cost
from .settings import DiagnosisSettings
from .stepwise_selection import diagnose
from .story_forces import StoryLaw, story_laws
from .trigger import Request, WatchSettings
from .verdict import Diagnosis
from .witness import compare_witnesses, contradictions
from .witness_record import WitnessRecord, WitnessSensor
from .wording import contradicted, csd_error_in_words, in_words

__all__ = [
    "FAR",
    "ClockDrift",
    "Diagnosis",
    "DiagnosisSettings",
    "HeldOutGain",
    "Request",
    "Score",
    "StoryLaw",
    "WatchSettings",
    "WitnessRecord",
    "WitnessSensor",
    "add_observed_causes",
    "clock_drift_in_words",
    "compare_witnesses",
    "confirm_on_held_out",
    "content",
    "contradicted",
    "contradictions",
    "correct_clock_drifts",
    "csd_error_in_words",
    "ddi_effect",
    "detectable_losses",
    "diagnose",
    "effects_text",
    "fitted_model",
    "healthy_prior",
    "in_words",
    "is_significant",
    "model_from_plain",
    "model_to_plain",
    "other_optima",
    "parameter_cost",
    "refit",
    "residual_bands",
    "score",
    "standing_causes",
    "state_clock_drifts",
    "story_laws",
    "structure_text",
    "trigger",
    "withdraw_other_structure",
]
