from . import healthy_prior as healthy_prior, trigger as trigger
from .clock_drift import (
    ClockDrift as ClockDrift,
    clock_drift_in_words as clock_drift_in_words,
    correct_clock_drifts as correct_clock_drifts,
    state_clock_drifts as state_clock_drifts,
)
from .cross_validation import HeldOutGain as HeldOutGain, confirm_on_held_out as confirm_on_held_out
from .damage_index_effect import ddi_effect as ddi_effect
from .detectable_loss import detectable_losses as detectable_losses
from .drawing_refit import (
    other_optima as other_optima,
    refit as refit,
    withdraw_other_structure as withdraw_other_structure,
)
from .files import (
    content as content,
    effects_text as effects_text,
    model_from_plain as model_from_plain,
    model_to_plain as model_to_plain,
    standing_causes as standing_causes,
    structure_text as structure_text,
)
from .fold_refit import fitted_model as fitted_model
from .lack_of_fit import residual_bands as residual_bands
from .observed_causes import add_observed_causes as add_observed_causes
from .parameter_uncertainty import is_significant as is_significant
from .plan import FAR as FAR
from .predictive_score import Score as Score, score as score
from .score_test import parameter_cost as parameter_cost
from .settings import DiagnosisSettings as DiagnosisSettings
from .stepwise_selection import diagnose as diagnose
from .story_forces import StoryLaw as StoryLaw, story_laws as story_laws
from .trigger import Request as Request, WatchSettings as WatchSettings
from .verdict import Diagnosis as Diagnosis
from .witness import compare_witnesses as compare_witnesses, contradictions as contradictions
from .witness_record import WitnessRecord as WitnessRecord, WitnessSensor as WitnessSensor
from .wording import (
    contradicted as contradicted,
    csd_error_in_words as csd_error_in_words,
    in_words as in_words,
    not_relied_on as not_relied_on,
)
