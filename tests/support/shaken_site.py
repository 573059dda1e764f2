"""The site file of a frame that is shaken."""

from __future__ import annotations

from tests.events.shaken import structure_text

SITE = f"""
[site]
name = "bench"
[output]
dir = "out"
[recorder]
enabled = false
[watch]
diagnose = false
{structure_text()}[[events.limits]]
drift_ratio = 1e-5
says = "go and look"
"""
