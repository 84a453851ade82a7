"""Errors about the user's input. The message says what is wrong, in which file, and how to fix it."""

import unicodedata

LONGEST_MESSAGE = 600  # characters
LONGEST_QUOTE = 100  # characters of a name or a reason that comes from a file
# Control characters, formatting such as text direction, lone surrogates, and line separators.
UNSHOWN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def shown(text: str, longest: int = LONGEST_QUOTE) -> str:
    """Returns text from outside as one line that is safe on a terminal.

    Characters that a terminal would obey instead of showing, such as escape sequences and line ends,
    become backslash escapes. A text longer than `longest` characters loses its middle.
    """
    # Bounds the work first: an escape never shortens the text.
    escaped = "".join(_escaped(character) for character in _shortened(text, 2 * longest))
    return _shortened(escaped, longest)


def is_shown(character: str) -> bool:
    """Returns whether a terminal shows a character, instead of obeying it or failing to encode it."""
    return unicodedata.category(character) not in UNSHOWN


class InputError(ValueError):
    """Bad input from outside. The command line prints it as one sentence and exits with code 2.

    The message is one line of at most `LONGEST_MESSAGE` characters, also if it quotes a file. The library
    does not know the command line, so a message never names an option. Where a parameter of the caller helps,
    it is named in `options`, and a command that has an option of this name points to it.

    Attributes:
        options: names of parameters that help, such as "max_gaussians", or with a value, such as
            "resume runs/garden".
    """

    def __init__(self, message: object = "", *, options: tuple[str, ...] = ()) -> None:
        super().__init__(shown(str(message), LONGEST_MESSAGE))
        self.options = options


class DatasetError(InputError):
    """A capture that cannot be trained on as it is."""


class FormatError(InputError):
    """A file that is not what it claims to be."""


def _escaped(character: str) -> str:
    return character if is_shown(character) else character.encode("unicode_escape").decode()


def _shortened(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    end = (longest - 5) // 2
    return f"{text[: longest - 5 - end]} ... {text[-end:]}"
