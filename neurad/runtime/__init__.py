"""The machine: threads, clock, allocator, compiled code and the rule that chooses it."""
