"""How far a result is from the best possible: what is used by ``neurad bench bound``."""
