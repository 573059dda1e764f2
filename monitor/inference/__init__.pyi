from .corrected_posterior import CorrectedPosterior as CorrectedPosterior, correct_posterior as correct_posterior
from .cross_spectra import Band as Band, extra_mode_spectra as extra_mode_spectra
from .driven_posterior import DrivenPosterior as DrivenPosterior
from .exact_simulation import (
    draw_forces as draw_forces,
    linearization_error as linearization_error,
    simulate_spectra as simulate_spectra,
)
from .excitation_fit import ExcitationStart as ExcitationStart, fit_excitation as fit_excitation
from .force_levels import fit_levels as fit_levels, spectra_by_force as spectra_by_force
from .forward_model import Prediction as Prediction
from .higher_moments import (
    MeasuredMoments as MeasuredMoments,
    Moments as Moments,
    measure_moments as measure_moments,
    normal_moments as normal_moments,
    tone_log_odds as tone_log_odds,
)
from .input_response import Drive as Drive
from .linearization import linearize as linearize
from .map_estimate import MapEstimate as MapEstimate, maximize_posterior as maximize_posterior, unfitted as unfitted
from .observed_spectra import (
    ObservedSpectra as ObservedSpectra,
    class_temperature as class_temperature,
    classify as classify,
    information_weight as information_weight,
)
from .parameter_layout import ParameterLayout as ParameterLayout
from .posterior import (
    FORCE_STD as FORCE_STD,
    Posterior as Posterior,
    join_coordinates as join_coordinates,
    with_coordinates as with_coordinates,
)
from .segments import Segments as Segments, gather as gather
from .starting_point import guess_levels as guess_levels, make_posterior as make_posterior
from .system_slopes import unpacked as unpacked
from .trial import require_finite as require_finite, tried as tried
