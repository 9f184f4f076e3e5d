"""The one exception that a user's mistake raises."""


class InputError(Exception):
    """Input that neurad cannot use: one sentence that names the file or option and what is wrong with it.

    The command line prints the sentence and ends with exit code 2, without a traceback.
    """
