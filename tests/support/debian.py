"""What comes from Debian and not with the package: absent, a test is skipped by name, but fails where CI installs it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest


def mosquitto() -> str | None:
    """The broker, which Debian puts where only root looks for commands."""
    return shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")


_SIGNS = {
    "systemd": lambda: shutil.which("systemd-analyze") is not None,
    "chromium": lambda: shutil.which("chromium") is not None,
    "mosquitto": lambda: mosquitto() is not None,
    "mesa-vulkan-drivers": lambda: any(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")),
}


def demand(package: str) -> None:
    """Go on only with this package."""
    if _SIGNS[package]():
        return
    reason = f"Debian package {package} is absent"
    if os.environ.get("CI") == "true":
        pytest.fail(reason)
    pytest.skip(reason)
