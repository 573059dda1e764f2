"""JSON schema of a line of results.jsonl, for tools that read results.mcap."""

from __future__ import annotations

from typing import Any

_NUMBER = {"type": ["number", "null"]}
_NUMBERS = {"type": ["array", "null"], "items": _NUMBER}
_INTEGERS = {"type": ["array", "null"], "items": {"type": "integer"}}
_STRINGS = {"type": ["array", "null"], "items": {"type": "string"}}
_LISTS = (
    "frequencies_hz", "frequencies_std_hz", "damping_ratio", "damping_std", "stiffness_n_per_m", "stiffness_std",
    "ddi", "ddi_std", "ddi_sequential", "loss_n_per_m", "temperature_effect",
)  # fmt: skip
MODAL_KEYS = ("frequency_change", "frequency_change_std", "shape_change", "shape_change_std", "frequency_effect")
"""Keys of what is judged without a model. [names; definition]"""

LINE_SCHEMA: dict[str, Any] = {
    "title": "shm.Window",
    "type": "object",
    "properties": {
        "window": {"type": "integer"},
        "t_end_ns": {"type": "integer"},
        "window_s": {"type": "number"},
        **dict.fromkeys(_LISTS, _NUMBERS),
        "mode_shapes": {"type": ["array", "null"], "items": {"type": "array", "items": {"type": ["array", "null"]}}},
        "order": {"type": ["integer", "null"]},
        "refined": {"type": ["boolean", "null"]},
        "unidentified": _INTEGERS,
        "detectable_loss": {"type": ["array", "null"], "items": _NUMBER},
        "rms_m_s2": _NUMBER,
        "model_modes": _INTEGERS,
        "mode_tracks": _INTEGERS,
        "other_modes": {"type": ["array", "null"], "items": {"type": "object"}},
        "misfit": _NUMBER,
        "temperature_degc": _NUMBER,
        "covariates": {"type": "object", "additionalProperties": _NUMBER},
        "covariate_effect": {"type": ["object", "null"], "additionalProperties": _NUMBERS},
        **dict.fromkeys(MODAL_KEYS[:-1], _NUMBERS),
        "frequency_effect": {"type": ["object", "null"], "additionalProperties": _NUMBERS},
        "alarm": {
            "type": "object",
            "properties": {
                "level": {"type": "string"},
                "stories": _INTEGERS,
                "reason": {"type": "string"},
                "active": {"type": "object", "additionalProperties": {"type": "string"}},
                "shelved": _INTEGERS,
                "changed": _STRINGS,
            },
        },
        "channels_left_out": _STRINGS,
        "left_out_reasons": _STRINGS,
        "rates_hz": _NUMBERS,
        "skipped": {"type": ["string", "null"]},
    },
    "required": ["t_end_ns", "alarm", "skipped"],
}
