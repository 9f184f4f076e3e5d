"""Camera files: NeRF, nerfstudio, COLMAP, Polycam and FIPT."""
