"""Lines of results, health and messages of a made-up period."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

T0 = 1_767_225_600 * 10**9  # 2026-01-01
HOP = 600 * 10**9
ALARM = range(10_000, 10_200)
SKIPPED = range(3_000, 3_144)


def line_of(k: int) -> dict[str, object]:
    """A window of a frame that follows the weather, loses 8 % of story 2 for a day and a half, and once cannot say."""
    line = dict.fromkeys(
        ("frequencies_hz", "frequencies_std_hz", "ddi", "ddi_std", "temperature_degc", "misfit", "mode_tracks"), None
    )
    alarm: dict[str, Any] = {"level": "normal", "stories": [], "reason": "no significant loss", "active": {}}
    out = {"window": k, "t_end_ns": T0 + (k + 1) * HOP, **line, "skipped": None, "alarm": alarm}
    if k in SKIPPED:
        return {**out, "skipped": f"channel a3 was stuck (for {k} s)"}
    warmth = 5.0 + 10.0 * np.sin(2 * np.pi * k / 144) + 0.001 * k
    f = np.array([2.5, 7.25, 11.5]) * (1 - 0.001 * warmth)
    ddi = np.array([0.0, 0.08 if k in ALARM else 0.0, 0.0]) + 0.003 * np.sin(k * np.arange(1.0, 4.0))
    if k in ALARM:
        level = "warning" if k < ALARM[-1] else "alarm"
        alarm |= {"level": level, "stories": [2], "reason": "story 2 lost 8 %", "active": {"2": level}}
    figures = {"frequencies_hz": f.tolist(), "frequencies_std_hz": [0.002] * 3, "mode_tracks": [0, 1, 2]}
    figures |= {
        "ddi": ddi.tolist(),
        "ddi_std": [0.002] * 3,
        "temperature_degc": warmth,
        "covariates": {"temperature": warmth},
        "misfit": 1.0,
    }
    return {**out, **figures}


def json_lines(path: Path, rows: list[dict[str, object]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
