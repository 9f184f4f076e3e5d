"""Lamps that are not known: found, measured in photographs, recovered, scored."""
