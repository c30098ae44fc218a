"""What README and the pages of docs print for a shell, taken out of their blocks."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# docs/errors.md is written by tests/commands/test_common_mistakes.py, which runs its commands.
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.name != "errors.md")]
_BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\n(?P<body>.*?)^ *```$", re.MULTILINE | re.DOTALL)
_STARTS = (
    "vpd-", "make ", "python ", "pip ", "source ", "export ", "mkdir ", "printf ", "srun ", "$TRAIN ", "TRAIN=",
    "VPD_DEBUG=1 ", "OMP_NUM_THREADS=1 ", "#",
)  # fmt: skip
_PROGRAMS = ("vpd-", "make ", "python ", "pip ", "srun ")
# A comment on the line of a command stands behind two blanks.
_COMMENT = re.compile(r"\s{2,}.*$|\s#\s.*$")


@dataclass(frozen=True)
class Command:
    """One command as a page prints it."""

    page: str
    text: str

    @property
    def words(self) -> list[str]:
        """Words as a shell takes them; places such as ``ckpt=FILE`` name a model of the tests."""
        return [_without_placeholder(word) for word in shlex.split(self.text)]

    def __str__(self) -> str:
        return f"{self.page}: {self.text}"


def blocks(page: Path, language: str) -> list[str]:
    """Return the blocks of a language (``""``: none is named), without their indentation."""
    found = []
    for match in _BLOCK.finditer(page.read_text()):
        if match["language"] == language:
            found.append(re.sub(rf"^{match['indent']}", "", match["body"], flags=re.MULTILINE))
    return found


def commands() -> list[Command]:
    """Return every command of every page, in the order in which they are printed.

    Raises:
        ValueError: a block of commands holds a line that starts in a way that is not known here.
    """
    found = []
    for page in PAGES:
        for block in [*blocks(page, ""), *blocks(page, "bash")]:
            lines = [line for line in _joined(block).splitlines() if line.strip()]
            if not any(line.startswith(_PROGRAMS) for line in lines):
                continue  # a tree of folders, a file format
            unknown = [line for line in lines if not line.startswith(_STARTS)]
            if unknown:
                raise ValueError(f"{page.name}: what kind of command is {unknown[0]!r}?")
            found += [Command(page.name, _bare(line)) for line in _expanded(lines) if not line.startswith("#")]
    return found


def _joined(block: str) -> str:
    return re.sub(r" *\\\n\s*", " ", block)


def _bare(line: str) -> str:
    return _COMMENT.sub("", line).strip()


def _expanded(lines: list[str]) -> list[str]:
    """Put the value of ``TRAIN="..."`` in the place of ``$TRAIN``."""
    value = next((shlex.split(line)[0].partition("=")[2] for line in lines if line.startswith("TRAIN=")), "")
    return [line.replace("$TRAIN", value, 1) for line in lines if not line.startswith("TRAIN=")]


def _without_placeholder(word: str) -> str:
    word = re.sub(r"runs/demo/(?:RUN|<run>)", "runs/demo/seed0", word)
    word = re.sub(r"runs/(?:mujoco_block|movi_a)/(?:RUN|<run>)", "runs/demo/seed0", word)
    return re.sub(r"\b(?:FILE|MODEL)\b", "runs/demo/seed0/checkpoints/last.ckpt", word)
