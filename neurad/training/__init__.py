"""The Lightning module, its objective and the one training step."""
