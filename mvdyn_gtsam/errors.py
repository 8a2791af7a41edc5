"""The one tree of errors a user can cause; the command line turns each into one clear line."""


class MvdynError(Exception):
    """Base of every error whose message is meant for the user: it names the file and the fix."""


class CaptureError(MvdynError):
    """The input cannot be used: missing, truncated, inconsistent or undecodable."""


class ConfigError(MvdynError):
    """A configuration key is unknown or its value is out of range."""


class DepthPriorError(MvdynError):
    """A depth prior cannot be used: its predictions are malformed or fit no scale of the scene."""


class TrackingError(MvdynError):
    """The capture was read but no reconstruction could be made of it."""


class ResultError(MvdynError):
    """A reconstruction folder is missing, incomplete or cannot be written."""


class EvaluationError(MvdynError):
    """Ground truth and reconstruction cannot be compared."""


class BaselineError(MvdynError):
    """A baseline (COLMAP, GLOMAP) failed to run."""


class ViewerError(MvdynError):
    """A result cannot be shown: the viewer's extra is missing, or its address cannot be used."""
