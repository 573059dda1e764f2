"""Rerun recordings of the results and of a diagnosis."""
