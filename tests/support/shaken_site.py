"""The site file of a frame that is shaken."""

from __future__ import annotations

from tests.events.shaken import HEIGHTS, MASSES, STIFFNESS

SITE = f"""
[site]
name = "bench"
[output]
dir = "out"
[recorder]
enabled = false
[watch]
diagnose = false
[structure]
kind = "shear_frame"
masses_kg = {MASSES.tolist()}
stiffness_n_per_m = {STIFFNESS.tolist()}
damping_ratio = 0.02
story_heights_m = {HEIGHTS.tolist()}
[[sensors]]
channel = "a1"
floor = 1
[[sensors]]
channel = "a2"
floor = 2
[[sensors]]
channel = "a3"
floor = 3
[[events.limits]]
drift_ratio = 1e-5
says = "go and look"
"""
