from . import healthy_prior, trigger
from .cross_validation import HeldOutGain, heldout_gain, require_gain
from .damage_index_effect import ddi_effect
from .files import content, effects_text, model_from_plain, model_to_plain, structure_text
from .fold_refit import fitted_model
from .initial_fit import FAR
from .lack_of_fit import residual_bands
from .parameter_uncertainty import is_significant
from .predictive_score import Score, score
from .score_test import parameter_cost
from .settings import DiagnosisSettings
from .stepwise_selection import Diagnosis, diagnose
from .trigger import Request, WatchSettings
from .wording import contradicted, headline, in_words, separating_measurement

__all__ = [
    "FAR",
    "Diagnosis",
    "DiagnosisSettings",
    "HeldOutGain",
    "Request",
    "Score",
    "WatchSettings",
    "content",
    "contradicted",
    "ddi_effect",
    "diagnose",
    "effects_text",
    "fitted_model",
    "headline",
    "healthy_prior",
    "heldout_gain",
    "in_words",
    "is_significant",
    "model_from_plain",
    "model_to_plain",
    "parameter_cost",
    "require_gain",
    "residual_bands",
    "score",
    "separating_measurement",
    "structure_text",
    "trigger",
]
