"""Exceptions and warnings. Their text is that of the command line: the place, what is wrong, and what to do about it."""


class Error(Exception):
    """Something went wrong; base of the other exceptions of this package."""


class UsageError(Error, ValueError):
    """An argument, a recipe or an image is not one that can be used."""


class DataError(Error, ValueError):
    """Something in a file is not as it must be: a recording, a model, a picture."""


class FileError(Error, OSError):
    """A file or folder could not be read or written."""


class Notice(UserWarning):
    """Something the user should know; nothing stops for it."""


for _class in (Error, UsageError, DataError, FileError, Notice):
    # Where users import them from.
    _class.__module__ = "steersman"
