"""Trainable functions over surfaces: hash grid and MLP, and the fields of albedo, roughness and radiance on them."""
