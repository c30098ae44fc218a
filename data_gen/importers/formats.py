"""The formats that can be imported, and which of them a path holds."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from data_gen.importers.recording import Recording
from data_gen.importers.settings import AUTO, ImportSettings
from data_gen.settings import require_choice
from vpd_lightning.errors import ConfigError, DataError

# name -> (module beside this one, what its sources look like)
FORMATS = {
    "plain": ("plain_folder", "a folder with cameras.json (or folders with one each)"),
    "transforms": ("transforms_json", "transforms.json of nerfstudio or instant-ngp, with times"),
    "kubric": ("kubric_folder", "Kubric's output: metadata.json, rgba_*.png, depth_*.tiff"),
    "movi": ("movi_records", "MOVi's TFDS records: *.tfrecord*"),
    "tum": ("tum_rgbd", "TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt"),
    "ros": ("ros_bag", "ROS 1 or 2 bags (.bag, .db3, .mcap), with mapping=FILE"),
    "lerobot": ("lerobot", "LeRobot v3: meta/info.json, with mapping=FILE"),
}


class ImportFormat(Protocol):
    """What each format's module offers."""

    def matches(self, path: Path) -> bool:
        """Tell cheaply whether the path looks like this format."""
        ...

    def recordings(self, path: Path, settings: ImportSettings) -> Iterator[Recording]:
        """List the recordings; raise ``DataError`` for what is broken."""
        ...


def open_format(path: Path, wanted: str) -> tuple[str, ImportFormat]:
    """Return the name and module of the wanted format, or of the one that the path matches.

    Raises:
        ConfigError: an unknown name, or a path that several formats match.
        DataError: no path, or none that any format matches.
    """
    if wanted != AUTO:
        require_choice("format", wanted, [AUTO, *FORMATS])
    if not path.exists():
        raise DataError(
            f"There is no {path}.\nGive the folder or file of your recording: vpd-data import SOURCE out=FOLDER"
        )
    if wanted != AUTO:
        return wanted, _module(wanted)
    found = matching_formats(path)
    if not found:
        raise DataError(
            f"{path} is none of the formats that can be imported: {', '.join(FORMATS)}.\n"
            "docs/your_data.md shows what each looks like; the simplest is plain, a folder with cameras.json."
        )
    if len(found) > 1:
        raise ConfigError(f"{path} looks like {' and '.join(found)}. Say which: format={found[0]}")
    return found[0], _module(found[0])


def matching_formats(path: Path) -> list[str]:
    """Return the names of the formats that a path looks like."""
    return [name for name in FORMATS if _module(name).matches(path)]


def _module(name: str) -> ImportFormat:
    return cast(ImportFormat, import_module(f"data_gen.importers.{FORMATS[name][0]}"))
