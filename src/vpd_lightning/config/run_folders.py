"""Names of run folders, chosen once, by rank 0.

``<root>/<experiment>/<timestamp>_<hash of overrides>``; a job of a named sweep has a place that follows from its words:
``<root>/sweeps/<sweep>/<experiment>/<slug of overrides>``.
"""

import hashlib
import os
import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

# Rank 0 tells the processes it starts where the run lies.
ENVIRONMENT = "VPD_RUN_FOLDER"
# Keys that the folder's path gives already, or that do not change the results.
_UNNAMED = ("sweep", "sweep_name", "experiment", "resume", "evaluate", "num_threads", "debug")
_UNNAMED_SECTIONS = ("run.", "hydra.", "hydra/")
_MAX_SLUG = 100


def choose_run_folder(folder: str | None, root: str, experiment: str, overrides: Sequence[str]) -> str:
    """Return the absolute folder of a run; one that does not exist yet, unless the caller named it."""
    named = os.environ.get(ENVIRONMENT)
    if named:
        return named
    if folder:
        return str(Path(folder).expanduser().absolute())
    digest = hashlib.sha256("\n".join(sorted(str(word) for word in overrides)).encode()).hexdigest()[:8]
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{digest}"
    parent = Path(root).expanduser().absolute() / experiment
    chosen, count = parent / name, 2
    while chosen.exists():
        chosen, count = parent / f"{name}_{count}", count + 1
    return str(chosen)


def sweep_folder(root: str, sweep: str) -> Path:
    """Return the absolute folder of a named sweep."""
    return Path(root).expanduser().absolute() / "sweeps" / sweep


def sweep_slug(overrides: Sequence[str], parameters: Sequence[str]) -> str:
    """Return the name of a sweep job's folder: its overrides, readable, the sweep's own parameters first.

    The order of ``overrides`` does not matter. Words that differ give names that differ: where letters had to be
    replaced or cut off, a hash of all words ends the name.

    Args:
        overrides: the words of the job.
        parameters: the keys that the sweep itself lists.
    """
    given = {word.partition("=")[0]: word for word in sorted(overrides) if _is_named(word.partition("=")[0])}
    keys = [key for key in parameters if key in given]
    keys += [key for key in given if key not in keys]
    if not keys:
        return "default"
    raw = "__".join("-".join(given[key].split("=", 1)) for key in keys)
    slug = re.sub(r"[^\w.+-]+", "-", raw, flags=re.ASCII)
    if slug == raw and len(slug) <= _MAX_SLUG:
        return slug
    digest = hashlib.sha256("\n".join(given[key] for key in keys).encode()).hexdigest()[:8]
    return f"{slug[:_MAX_SLUG].strip('-_')}_{digest}"


def _is_named(key: str) -> bool:
    return key not in _UNNAMED and not key.startswith(_UNNAMED_SECTIONS)
