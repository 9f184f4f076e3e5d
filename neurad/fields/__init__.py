"""Fields: trainable functions of surface points. A position is encoded by a hash grid (Mueller et al. 2022) or a dense
grid, and read by a network, as albedo, roughness or reflected radiance (Hadadan et al. 2021, 2023).
"""
