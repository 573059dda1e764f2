from .corrected_posterior import CorrectedPosterior, correct_posterior
from .cross_spectra import Band, extra_mode_spectra
from .driven_posterior import DrivenPosterior
from .exact_simulation import draw_forces, linearization_error, simulate_exact, simulate_spectra
from .excitation_fit import ExcitationStart, fit_excitation, forces_from_quiet_segments
from .force_levels import fit_levels, spectra_by_force
from .forward_model import Prediction
from .higher_moments import MeasuredMoments, Moments, measure_moments, normal_moments, simulate_moments, tone_log_odds
from .input_response import Between, Drive
from .linearization import linearize
from .map_estimate import MapEstimate, maximize_posterior, unfitted
from .observed_spectra import ObservedSpectra, class_temperature, classify, information_weight
from .parameter_layout import ParameterLayout
from .posterior import FORCE_STD, Posterior, join_coordinates, with_coordinates
from .segments import LeftOut, Segments, gather
from .starting_point import FORCED, guess_levels, make_posterior

__all__ = [
    "FORCED",
    "FORCE_STD",
    "Band",
    "Between",
    "CorrectedPosterior",
    "Drive",
    "DrivenPosterior",
    "ExcitationStart",
    "LeftOut",
    "MapEstimate",
    "MeasuredMoments",
    "Moments",
    "ObservedSpectra",
    "ParameterLayout",
    "Posterior",
    "Prediction",
    "Segments",
    "class_temperature",
    "classify",
    "correct_posterior",
    "draw_forces",
    "extra_mode_spectra",
    "fit_excitation",
    "fit_levels",
    "forces_from_quiet_segments",
    "gather",
    "guess_levels",
    "information_weight",
    "join_coordinates",
    "linearization_error",
    "linearize",
    "make_posterior",
    "maximize_posterior",
    "measure_moments",
    "normal_moments",
    "simulate_exact",
    "simulate_moments",
    "simulate_spectra",
    "spectra_by_force",
    "tone_log_odds",
    "unfitted",
    "with_coordinates",
]
