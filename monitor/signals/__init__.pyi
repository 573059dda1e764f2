from . import (
    alignment,
    beside,
    channel_faults,
    channel_relations,
    channel_watch,
    lost_samples,
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
from .front_end import FrontEnd
from .lost_samples import LostState
from .neighbours import NORMAL_MAD
from .repeats import KnownBlocks
from .resampling import Conditioner, ConditionState
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
    "ConditionState",
    "Conditioner",
    "Drift",
    "FrontEnd",
    "Health",
    "HealthSettings",
    "HealthState",
    "KnownBlocks",
    "LostState",
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
    "hann_amplitude",
    "leakage",
    "lost_samples",
    "mains_hum",
    "overlap_correlation",
    "repeats",
    "sensor_drift",
    "sensor_health",
    "stillness",
    "taper",
    "temperature",
    "transform",
    "window_quality",
    "windows",
]
