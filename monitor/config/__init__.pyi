from . import configuration, security_check
from .configuration import Configuration, OutputSettings, SensorTable, read_toml
from .recording_errors import read_by_user
from .service_settings import LogSettings, StateSettings

__all__ = [
    "Configuration",
    "LogSettings",
    "OutputSettings",
    "SensorTable",
    "StateSettings",
    "configuration",
    "read_by_user",
    "read_toml",
    "security_check",
]
