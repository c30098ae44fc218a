"""The error that refuses a file, and the name of its fault."""

from pathlib import Path

from vpd_lightning.errors import DataError

_WAY_OUT = "Write it again with `vpd-data generate`, or see docs/your_data.md for the format."


class BrokenFileError(DataError):
    """A file that is not read; ``kind`` names the fault in one word, for example ``left_handed_pose``."""

    def __init__(self, message: str, kind: str = "unreadable") -> None:
        super().__init__(message)
        self.kind = kind

    def __reduce__(self) -> tuple[type["BrokenFileError"], tuple[str, str]]:
        return type(self), (str(self), self.kind)  # crosses process borders with its kind


def refuse(path: Path, kind: str, fault: str, way_out: str = _WAY_OUT) -> BrokenFileError:
    """Return (not raise) the error that names the file, its fault and what to do."""
    return BrokenFileError(f"{path}: {fault}.\n{way_out}", kind)


def brief(error: BaseException) -> str:
    """Return what an error says, on one line and not endlessly."""
    return " ".join(str(error).split())[:160] or type(error).__name__
