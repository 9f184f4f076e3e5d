"""Optional packages: the sentence about a missing one, and whether it is there, asked before any work."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from neurad.core.errors import InputError

_PACKAGES = {"pxr": "usd-core", "cv2": "OpenCV", "imageio_ffmpeg": "imageio-ffmpeg"}
"""Names of packages that differ from those of their modules."""


def missing(module: str, extra: str, what: str) -> InputError:
    """The sentence that something needs a package, by its name in Python, which an extra of neurad installs."""
    return InputError(f"{what} needs the package {_PACKAGES.get(module, module)}: pip install 'neurad[{extra}]'")


@contextmanager
def needed(module: str, extra: str, what: str) -> Iterator[None]:
    """Around the import of a package that may be missing."""
    try:
        yield
    except ImportError as error:
        raise missing(module, extra, what) from error


def need(module: str, extra: str, what: str) -> None:
    """Check that a package is installed that is needed at the end of some work, without importing it."""
    if find_spec(module) is None:
        raise missing(module, extra, what)
