"""Which scenes can be generated: the folders of ``conf/data_gen``, one file for each preset. Imports nothing heavy."""

from pathlib import Path

from vpd_lightning.errors import ConfigError

_DESCRIPTION = "about:"


def preset_folder() -> Path:
    """Return ``conf/data_gen``: beside this package in a checkout, inside ``vpd_lightning`` in an installed wheel."""
    import vpd_lightning

    beside = Path(__file__).resolve().parent.parent / "conf" / "data_gen"
    inside = [Path(folder) / "conf" / "data_gen" for folder in vpd_lightning.__path__]
    for folder in (beside, *inside):
        if folder.is_dir():
            return folder
    raise ConfigError(f"The presets are missing: neither {beside} nor {inside[0]} exists. Reinstall the package.")


def scene_names() -> list[str]:
    """Return the scenes that can be generated."""
    return sorted(folder.name for folder in preset_folder().iterdir() if folder.is_dir())


def preset_names(scene: str) -> list[str]:
    """Return the presets of a scene."""
    return sorted(path.stem for path in (preset_folder() / scene).glob("*.yaml"))


def scene_description(scene: str) -> str:
    """Return what a scene shows: the line ``about: ...`` of the first of its presets that has one."""
    for path in sorted((preset_folder() / scene).glob("*.yaml")):
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith(_DESCRIPTION):
                return line.removeprefix(_DESCRIPTION).strip()
    return ""
