"""Everything that measures the product; it uses the product's own training step and has none of its own."""
