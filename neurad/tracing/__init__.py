"""Ray casting on the CPU: dense hits, no gradients."""
