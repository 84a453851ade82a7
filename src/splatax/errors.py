"""What the user gave cannot be used: the message says what, where, and the way out."""


class InputError(ValueError):
    """Bad input from outside. The command line prints it as one sentence and exits with 2."""


class DatasetError(InputError):
    """A capture that cannot be trained on as it is."""


class FormatError(InputError):
    """A file that is not what it claims to be."""
