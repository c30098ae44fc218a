"""What a check of a data set finds."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong; ``is_error`` is false for a remark."""

    name: str
    file: str
    message: str
    is_error: bool = True

    def __str__(self) -> str:
        kind = "fault" if self.is_error else "remark"
        return f"{kind} {self.name}: {self.file}: {self.message}"
