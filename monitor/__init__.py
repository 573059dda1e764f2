"""Online structural health monitoring: identification, model updating, damage index, alarms."""

__version__ = "0.1.0"
