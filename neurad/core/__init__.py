"""Records, protocols and the small mathematics that every other floor shares."""
