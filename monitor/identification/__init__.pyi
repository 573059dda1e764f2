from . import stabilization as stabilization, tracking as tracking
from .association import KnownModes as KnownModes
from .free_decay import with_decay_deviations as with_decay_deviations
from .model_free import identify_modes as identify_modes
from .single_modes import (
    BELL_PARAMETERS as BELL_PARAMETERS,
    CONVERGED_STDS as CONVERGED_STDS,
    SingleMode as SingleMode,
    fit_bell as fit_bell,
    fit_single_modes as fit_single_modes,
)
from .spectral_shape import (
    Scatter as Scatter,
    SpectralShape as SpectralShape,
    least_chance as least_chance,
    permute as permute,
)
from .ssi import SsiSettings as SsiSettings
from .stabilization import (
    LEAST_PERIODS as LEAST_PERIODS,
    LEAST_RECORD_S as LEAST_RECORD_S,
    SelectionSettings as SelectionSettings,
    expected_modes as expected_modes,
    identify as identify,
)
from .sub_array import SubArray as SubArray
from .tracking import TrackSettings as TrackSettings
from .whittle import RefinementSettings as RefinementSettings, refine as refine
