from . import (
    alignment as alignment,
    beside as beside,
    channel_faults as channel_faults,
    channel_relations as channel_relations,
    channel_watch as channel_watch,
    conditioned as conditioned,
    mains_hum as mains_hum,
    repeats as repeats,
    sensor_drift as sensor_drift,
    sensor_health as sensor_health,
    stillness as stillness,
    temperature as temperature,
    window_quality as window_quality,
    windows as windows,
)
from .beside import BesideState as BesideState
from .channel_faults import FALSE_RATE as FALSE_RATE
from .channel_watch import WatchState as WatchState
from .clock_line import SampleClock as SampleClock, sample_clock as sample_clock
from .conditioned import FilterRun as FilterRun, Stream as Stream
from .flags import runs_of as runs_of
from .front_end import FrontEnd as FrontEnd
from .held import each_once as each_once, times_held as times_held
from .neighbours import NORMAL_MAD as NORMAL_MAD
from .repeats import KnownBlocks as KnownBlocks
from .resampling import Conditioner as Conditioner
from .sensor_drift import Drift as Drift
from .sensor_health import Health as Health, HealthSettings as HealthSettings, HealthState as HealthState
from .settings import ProcessingSettings as ProcessingSettings
from .spectral_peaks import find_peaks as find_peaks
from .stillness import StillState as StillState
from .temperature import LAGS_S as LAGS_S, TemperatureSettings as TemperatureSettings
from .welch import (
    LEAKAGE_OFFSETS as LEAKAGE_OFFSETS,
    MAIN_LOBE_BINS as MAIN_LOBE_BINS,
    SegmentDesign as SegmentDesign,
    bin_correlation as bin_correlation,
    hann_amplitude as hann_amplitude,
    leakage as leakage,
    overlap_correlation as overlap_correlation,
    taper as taper,
    transform as transform,
)
from .whitened_shift import best_shift as best_shift
from .window_quality import QualitySettings as QualitySettings
from .windows import WindowGrid as WindowGrid, WindowState as WindowState
