"""Ray casting: dense hits, no gradients."""
