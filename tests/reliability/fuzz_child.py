"""Reads mutated files, one after the other; a process of its own, because a broken file may end it.

``python -m tests.reliability.fuzz_child TARGET FOLDER START COUNT SEED``: prints ``NUMBER WHAT`` for each;
WHAT is ``read``, ``refused`` (by an error meant for it) or ``other`` with the error's name.
"""

import contextlib
import io
import random
import resource
import shutil
import signal
import sys
import warnings
from pathlib import Path

from tests.reliability.mutations import mutated
from vpd_lightning.errors import VPDError

MAX_SECONDS, MAX_BYTES = 60, 8 * 2**30


def read_trajectory(path: Path) -> None:
    """Read everything that a training, an evaluation or a validation reads."""
    from data_gen.inspection.validate import validate_dataset
    from vpd_lightning.data.ground_truth import has_state, read_state
    from vpd_lightning.data.reader import TrajectoryReader

    with TrajectoryReader(path) as reader:
        reader.rgb()
        reader.depth()
    if has_state(path):
        read_state(path)
    validate_dataset(path)


def harm_trajectory(folder: Path, draw: random.Random) -> Path:
    """Mutate a whole file, or one time in four a hostile one, into ``folder/mutants/mutant.h5``."""
    kind = "whole" if draw.random() < 0.75 else "hostile"
    good = draw.choice(sorted((folder / kind).glob("*.h5")))
    path = folder / "mutants" / "mutant.h5"
    path.write_bytes(mutated(good.read_bytes(), draw))
    return path


def read_source(source: Path) -> None:
    """Import a source of any format."""
    from data_gen.importers.run import import_recordings

    out = source.parent / "imported"
    shutil.rmtree(out, ignore_errors=True)
    mapping = source / "mapping.yaml"
    words = {"workers": 1} | ({"mapping": str(mapping)} if mapping.is_file() else {})
    with contextlib.redirect_stdout(io.StringIO()):
        import_recordings(source, out, words)


def harm_source(folder: Path, draw: random.Random) -> Path:
    """Copy one of the sources in ``folder/good`` and mutate one or two of its files."""
    good = draw.choice(sorted((folder / "good").iterdir()))
    source = folder / "mutants" / good.name
    shutil.rmtree(folder / "mutants", ignore_errors=True)
    shutil.copytree(good, source)
    files = sorted(path for path in source.rglob("*") if path.is_file())
    # Lists and headers are few among many pictures.
    texts = [path for path in files if path.suffix in (".json", ".yaml", ".txt", ".parquet", ".db3")]
    for _ in range(draw.randint(1, 2)):
        path = draw.choice(texts if texts and draw.random() < 0.6 else files)
        path.write_bytes(mutated(path.read_bytes(), draw))
    return source


TARGETS = {"reader": (harm_trajectory, read_trajectory), "importers": (harm_source, read_source)}


def main() -> None:
    """Harm and read."""
    target, folder, start, count, seed = sys.argv[1], Path(sys.argv[2]), *map(int, sys.argv[3:6])
    harm, read = TARGETS[target]
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    for number in range(start, start + count):
        path = harm(folder, random.Random(f"{seed} {number}"))
        print(number, end=" ", flush=True)
        signal.alarm(MAX_SECONDS)  # a hang ends the process
        try:
            read(path)
            what = "read"
        except VPDError as error:
            what = "refused" if len(str(error).splitlines()) <= 5 else f"other long {type(error).__name__}"
        except Exception as error:
            what = f"other {type(error).__name__}: {' '.join(str(error).split())[:150]}"
        signal.alarm(0)
        print(what, flush=True)


if __name__ == "__main__":
    main()
