"""Plug-ins: other packages that add options, through the entry-point group ``vpd_lightning.plugins``.

An entry point names a module. It is imported just before composing; an optional attribute ``config_folder`` (a path)
joins the search path of the configuration, and classes below the module's top package may be built.
"""

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from vpd_lightning.errors import ConfigError

GROUP = "vpd_lightning.plugins"


class Plugins(NamedTuple):
    """What the installed plug-ins bring: packages whose classes may be built, and configuration folders."""

    packages: tuple[str, ...]
    config_folders: tuple[Path, ...]


@cache
def load_plugins() -> Plugins:
    """Import all plug-ins once.

    Raises:
        ConfigError: a plug-in cannot be imported, or its configuration folder is missing.
    """
    packages, folders = [], []
    for entry in sorted(entry_points(group=GROUP), key=lambda item: item.name):
        try:
            plugin = entry.load()
        except Exception as error:
            raise ConfigError(
                f"the plug-in {entry.name} ({entry.value}) cannot be loaded.\n{type(error).__name__}: {error}\n"
                "Repair or uninstall the package that brings it."
            ) from error
        packages.append(entry.module.split(".")[0])
        folder = getattr(plugin, "config_folder", None)
        if folder is not None:
            if not Path(folder).is_dir():
                raise ConfigError(f"the plug-in {entry.name} names a configuration folder that is missing: {folder}")
            folders.append(Path(folder).resolve())
    return Plugins(tuple(packages), tuple(folders))
