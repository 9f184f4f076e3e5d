"""Camera files: NeRF, nerfstudio, COLMAP, Polycam and FIPT."""

HOLD_OUT = 8
"""Every so many-th photograph is held out where nothing says which."""
