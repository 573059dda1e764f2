from . import stabilization, tracking
from .free_decay import with_decay_deviations
from .model_free import identify_modes
from .single_modes import BELL_PARAMETERS, CONVERGED_STDS, SingleMode, fit_bell, fit_single_modes
from .ssi import SsiSettings
from .stabilization import LEAST_PERIODS, LEAST_RECORD_S, SelectionSettings, expected_modes, identify
from .sub_array import SubArray
from .tracking import TrackSettings
from .whittle import RefinementSettings, refine

__all__ = [
    "BELL_PARAMETERS",
    "CONVERGED_STDS",
    "LEAST_PERIODS",
    "LEAST_RECORD_S",
    "RefinementSettings",
    "SelectionSettings",
    "SingleMode",
    "SsiSettings",
    "SubArray",
    "TrackSettings",
    "expected_modes",
    "fit_bell",
    "fit_single_modes",
    "identify",
    "identify_modes",
    "refine",
    "stabilization",
    "tracking",
    "with_decay_deviations",
]
