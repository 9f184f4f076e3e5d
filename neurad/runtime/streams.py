"""Standard streams of a process that was started without them, as daemons are."""

import os
import stat
import sys


def open_closed_streams() -> None:
    """Let standard input, output and errors that are closed lead nowhere.

    The next file that is opened gets the lowest free number: a checkpoint that gets number 2 would hold what
    libraries print about errors, and code that keeps a copy of stream 2 would fail.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
    # Python leaves the objects of closed streams None, and ``print`` to None goes to standard output.
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False, errors="backslashreplace")  # noqa: SIM115
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115


def silence_gone_terminals() -> None:
    """Let standard output and errors lead nowhere that belong to a terminal which is gone: writing to it fails."""
    for number in (1, 2):
        if stat.S_ISCHR(os.fstat(number).st_mode) and not os.isatty(number):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)


def flush_output() -> None:
    """Hand what was printed to the system now, where a failure can still be reported.

    Raises:
        OSError: standard output cannot be written, such as a file on a full disk.
    """
    if sys.stdout is not None and not sys.stdout.closed:
        try:
            sys.stdout.flush()
        except OSError:
            # What is left in the buffer would fail once more when Python ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            raise
