from . import configuration as configuration, security_check as security_check
from .configuration import (
    Configuration as Configuration,
    OutputSettings as OutputSettings,
    SensorTable as SensorTable,
    read_toml as read_toml,
)
from .recording_errors import read_by_user as read_by_user
from .service_settings import LogSettings as LogSettings, StateSettings as StateSettings
