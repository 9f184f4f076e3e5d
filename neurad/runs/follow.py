"""A run that may still be training: its newest checkpoint, as soon as there is one."""

from pathlib import Path

from neurad.checkpoints.find import LAST, run_folder_of
from neurad.core.errors import InputError
from neurad.runs.load import LoadedRun, reload_run


class Followed:
    """A loaded run and the last checkpoint of its folder.

    Args:
        run: as :func:`neurad.runs.load.load_run` gives it; one of another checkpoint than the last stays as it is.
    """

    def __init__(self, run: LoadedRun) -> None:
        folder = run_folder_of(run.checkpoint)
        assert folder is not None
        self.run = run
        """As it is now."""
        self.folder = folder
        self.problem = ""
        """Why a newer checkpoint was not taken over, in a sentence; empty where all is well."""
        self._path = folder / LAST
        self._follows = run.checkpoint.resolve() == self._path
        self._stamp = _stamp(self._path)

    def update(self) -> bool:
        """Take over a newer checkpoint, into the same parts; True if there was one, and :attr:`run` is another object.

        Without the file, or with one that cannot be used, everything stays as it is and :attr:`problem` says why.
        """
        stamp = _stamp(self._path)
        if not self._follows or (stamp == self._stamp and stamp is not None):
            return False
        if stamp is None:
            what = "the run folder" if not self.folder.exists() else LAST.name
            self.problem = f"{what} is gone ({self.folder}): this is the last state, of iteration {self.run.iteration}"
            return False
        self._stamp = stamp
        try:
            self.run = reload_run(self.run)
        except InputError as error:
            self.problem = str(error)
            return False
        self.problem = ""
        return True


def _stamp(path: Path) -> tuple[int, int] | None:
    """What changes with a file; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino
