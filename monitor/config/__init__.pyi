from . import configuration as configuration, security_check as security_check
from .configuration import (
    Configuration as Configuration,
    OutputSettings as OutputSettings,
    SensorTable as SensorTable,
    read_toml as read_toml,
)
from .service_settings import LogSettings as LogSettings, StateSettings as StateSettings
