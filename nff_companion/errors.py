"""Errors: one base class; each message says what was wrong, with which value, and what to do."""


class NffError(Exception):
    """Base of all errors raised on purpose by this package."""


class ConfigError(NffError, ValueError):
    """A configuration or airframe file cannot be used."""


class EndpointError(NffError, OSError):
    """A link endpoint cannot be opened or was lost."""


class LogError(NffError, ValueError):
    """A flight log cannot be read or lacks what is needed."""


class AllocationInfeasible(NffError, ArithmeticError):
    """No allocation matrix exists for the motors left."""


class SolverError(NffError, ArithmeticError):
    """A solver returned no usable solution."""


class MissingExtra(NffError, ImportError):
    """An optional package is not installed."""


class TunnelError(NffError, ValueError):
    """A message between the companion and the applet cannot be encoded or understood."""


class StateFileError(NffError, OSError):
    """A file of the state folder cannot be written or read."""


class JournalError(StateFileError):
    """The journal of changed parameters cannot be written or read."""


class FrameError(NffError, ValueError):
    """A frame of a simulator link cannot be understood."""


class NetworkError(NffError, ValueError):
    """A basis network cannot be used."""


class NotJudged(LogError):
    """A flight log can be read, but whether a motor failed cannot be told from it; the message says what is missing."""
