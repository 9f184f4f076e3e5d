"""What needs no fit and stands beside every score: imports nothing, so that tables are quick to read."""

CONSTANT, LOOKUP = "best constant", "true colour's lookup"
MARKS = {CONSTANT: "_constant", LOOKUP: "_lookup"}
"""By label, the end of its scores' names, before any region."""
