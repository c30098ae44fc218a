"""Small files about a data set: beside it where that can be written to, else in the user's cache folder."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from vpd_lightning.data.manifest import Manifest
from vpd_lightning.files import AtomicPath


def kept_files(manifest: Manifest, name: str) -> Iterator[Path]:
    """Yield the places where a file called ``name`` is, that beside the data set first."""
    yield from (path for folder in _folders(manifest) if (path := folder / name).is_file())


def keep_file(manifest: Manifest, name: str, write: Callable[[Path], object]) -> Path | None:
    """Let ``write`` fill the file in the first place that takes it, whole or not at all; None where none does."""
    for folder in _folders(manifest):
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with AtomicPath(path) as partial:
                write(partial)
        except OSError:
            continue
        return path
    return None


def _folders(manifest: Manifest) -> list[Path]:
    """The data set's own folder; in the cache, data sets are distinguished by their content."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        cache = Path(root) if root else Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return [manifest.folder]
    return [manifest.folder, cache / "vpd_lightning" / manifest.files_digest[:32]]
