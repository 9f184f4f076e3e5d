"""The laboratory: what measures the product. It runs the product's own training step and is not part of the wheel."""
