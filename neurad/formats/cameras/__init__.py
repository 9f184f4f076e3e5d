"""Camera files: NeRF, nerfstudio, COLMAP, Polycam and FIPT."""

HOLD_OUT = 8
"""Every so many-th photograph is held out where nothing says which."""
RELIGHT = "env_relight.exr"
"""Map that lights the photographs named by ``relight_path``; it replaces the scene's own, in the same frame."""
