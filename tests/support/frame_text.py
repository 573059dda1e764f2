"""The paper's three-story frame as the text of a structure file."""

THREE_STORIES = """
[structure]
kind = "shear_frame"
masses_kg = [0.3253, 0.3514, 0.3129]
stiffness_n_per_m = [2909.4511, 1514.8507, 1897.6986]
damping_ratio = 0.01
story_heights_m = [0.093, 0.093, 0.1]

[[sensors]]
channel = "a1"
floor = 1

[[sensors]]
channel = "a2"
floor = 2

[[sensors]]
channel = "a3"
floor = 3
"""
