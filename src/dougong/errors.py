"""Every exception the package raises on purpose.

DougongError
├── InputError          caller passed something unusable (also a ValueError)
├── FormatError         a file is damaged, empty or not what its name says
├── FrameError          two clouds live in frames that cannot be combined
├── RegistrationError   no pose can even be looked for (empty overlap, too few points)
├── OutputError         a result cannot be written (exists already, disk full)
└── TileError           some tiles of a large cloud failed; the others are done

Every message says, in this order: what is wrong, the value seen, what was expected, what to do.
"""


class DougongError(Exception):
    """Base class: ``except DougongError`` catches all of ours."""


class InputError(DougongError, ValueError):
    """An argument has the wrong shape, type, range or unit."""


class FormatError(DougongError):
    """A file is damaged, empty or not what its name says."""


class FrameError(DougongError):
    """Two clouds live in frames that cannot be combined."""


class RegistrationError(DougongError):
    """A registration cannot start."""


class OutputError(DougongError):
    """A result cannot be written."""


class TileError(DougongError):
    """Some tiles of a cloud could not be worked on; the others are done."""


class DataWarning(UserWarning):
    """The data had a fault that was handled and counted; the result stands."""
