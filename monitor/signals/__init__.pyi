from . import (
    alignment,
    beside,
    channel_faults,
    channel_relations,
    channel_watch,
    conditioned,
    mains_hum,
    repeats,
    sensor_drift,
    sensor_health,
    stillness,
    temperature,
    window_quality,
    windows,
)
from .beside import BesideState
from .channel_faults import FALSE_RATE
from .channel_watch import WatchState
from .conditioned import FilterRun
from .flags import runs_of
from .front_end import FrontEnd
from .neighbours import NORMAL_MAD
from .repeats import KnownBlocks
from .resampling import Conditioner
from .sensor_drift import Drift
from .sensor_health import Health, HealthSettings, HealthState
from .settings import ProcessingSettings
from .stillness import StillState
from .temperature import LAGS_S, TemperatureSettings
from .welch import (
    LEAKAGE_OFFSETS,
    SegmentDesign,
    bin_correlation,
    hann_amplitude,
    leakage,
    overlap_correlation,
    taper,
    transform,
)
from .window_quality import QualitySettings
from .windows import WindowGrid, WindowState

__all__ = [
    "FALSE_RATE",
    "LAGS_S",
    "LEAKAGE_OFFSETS",
    "NORMAL_MAD",
    "BesideState",
    "Conditioner",
    "Drift",
    "FilterRun",
    "FrontEnd",
    "Health",
    "HealthSettings",
    "HealthState",
    "KnownBlocks",
    "ProcessingSettings",
    "QualitySettings",
    "SegmentDesign",
    "StillState",
    "TemperatureSettings",
    "WatchState",
    "WindowGrid",
    "WindowState",
    "alignment",
    "beside",
    "bin_correlation",
    "channel_faults",
    "channel_relations",
    "channel_watch",
    "conditioned",
    "hann_amplitude",
    "leakage",
    "mains_hum",
    "overlap_correlation",
    "repeats",
    "runs_of",
    "sensor_drift",
    "sensor_health",
    "stillness",
    "taper",
    "temperature",
    "transform",
    "window_quality",
    "windows",
]
