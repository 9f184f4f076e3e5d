"""What training pixels say: derivatives, the correction of the roughness, error bars."""
