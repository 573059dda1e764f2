"""Tests on measured recordings: known faults put into them, and data sets that are downloaded by hand."""
