"""What a command says when it cannot do its work."""

import errno
from dataclasses import fields
from pathlib import Path

from splatax.errors import InputError
from splatax.io.files import disk_of

REASONS = {  # why a file cannot be used, and the way out
    errno.EEXIST: "a file, where a folder is needed. Choose another place.",
    errno.ENOTDIR: "lies below a file, where a folder is needed. Choose another place.",
    errno.EISDIR: "a folder, where a file is needed. Choose another name.",
    errno.EACCES: "not permitted. Choose a place that you may use.",
    errno.EPERM: "not permitted. Choose a place that you may use.",
    errno.EROFS: "cannot be written to ({disk}, is read-only). Choose another place.",
    errno.ENOSPC: "no space is left ({disk}). Free some, and run it again.",
    errno.EDQUOT: "your quota is used up ({disk}). Free some space, and run it again.",
    errno.EFBIG: "larger than files may be here ({disk}). Raise the limit, or choose another place.",
    errno.EIO: "the disk failed ({disk}). Choose another place.",
}


def sentence(error: OSError) -> str:
    """Returns which file an error is about, what is wrong, and the way out; for a disk also which one."""
    if error.filename is None:
        return f"{error.strerror or error}."
    reason = REASONS.get(error.errno or 0, f"{error.strerror or error}.")
    return f"{error.filename}: {reason.format(disk=disk_of(Path(str(error.filename))))}"


def advice(error: InputError, command: object) -> str:
    """Returns the message of an error, and which options of a command help."""
    known = {field.name for field in fields(command)}  # type: ignore[arg-type]  # commands are dataclasses
    named = [option.partition(" ") for option in error.options]
    flags = [f"--{name.replace('_', '-')}{space}{value}" for name, space, value in named if name in known]
    return f"{error} See {', '.join(flags)}." if flags else str(error)
