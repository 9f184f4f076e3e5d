"""Verbs of the command line beyond Lightning's, one file each; what they do lies in the floors below."""

import argparse
from typing import Protocol


class Verb(Protocol):
    """What a module of this package has. Nothing heavy is imported before :meth:`run`: ``-h`` answers at once."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options of the verb."""

    def run(self, options: argparse.Namespace) -> None:
        """Do it.

        Raises:
            InputError: the user's mistake, in one sentence.
        """
