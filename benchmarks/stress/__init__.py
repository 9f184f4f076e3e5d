"""The cases of ``neurad stress``, one module a family; each has ``cases()``."""
