"""Errors that a person can act on; each carries the exit code of the console commands."""


class VPDError(Exception):
    """Base of all errors that are shown without a traceback."""

    exit_code = 1


class ConfigError(VPDError):
    """The configuration asks for something that is not there or not allowed."""

    exit_code = 2


class EditError(ConfigError):
    """An edit of a scene that is invalid, selects nothing, or cannot be read."""


class ActionError(ConfigError):
    """A given motion that does not fit the scene: too short, not finite, elsewhere, or with jumps."""


class DataError(VPDError):
    """A data set or recording is missing, broken, or does not fit the configuration."""

    exit_code = 3


class EmptyWorkspaceError(DataError):
    """No measured pixel of any input view lies in the workspace."""


class RenderingBackendError(DataError):
    """No GL backend works on this machine."""


class CheckpointError(VPDError):
    """A file is not a checkpoint of ours, is damaged, or does not fit the model."""

    exit_code = 4


class OutOfMemoryError(VPDError):
    """Memory ran out; the message names the knobs to turn."""

    exit_code = 5


class LostProcessError(VPDError):
    """Another process of a training on several devices is gone."""

    exit_code = 6


class NonFiniteError(VPDError):
    """A loss or gradient became NaN or infinite; raised before the optimiser could use it."""


def one_line(error: BaseException, limit: int = 200) -> str:
    """Return another library's message as one line of at most ``limit`` characters: some fill pages."""
    text = " ".join(str(error).split())
    return text if len(text) <= limit else f"{text[: limit - 3]}..."
