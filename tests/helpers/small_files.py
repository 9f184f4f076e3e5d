"""Files that may not grow, as after ``ulimit -f``."""

import resource
from contextlib import contextmanager


@contextmanager
def small_files(limit):
    """No file may have more bytes.

    A context and not a fixture: pytest prints a test's outcome before its fixtures end, and where that goes to a file,
    it would be refused as well.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
