"""What a value or a line of a defaults list in ``conf/`` may ask for: ``${vpd_...:...}``."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from vpd_lightning.config.run_folders import choose_run_folder

_EVERY_MODEL = "default"


def register_resolvers(folders: Sequence[Path]) -> None:
    """Make the resolvers known to OmegaConf; ``folders`` hold the options, ours and those of others."""
    OmegaConf.register_new_resolver("vpd_run_folder", choose_run_folder, replace=True)
    OmegaConf.register_new_resolver("vpd_lookup", look_up, replace=True)
    OmegaConf.register_new_resolver("vpd_recorded", _recorded, replace=True)
    OmegaConf.register_new_resolver("vpd_recipe", partial(find_recipe, tuple(folders)), replace=True)


def look_up(key: object, table: Mapping[Any, Any], default: Any) -> Any:
    """Return the entry of a table written in place, such as ``${vpd_lookup:${size},{small:32},128}``."""
    return table.get(key, default)


def _recorded(folder: str, name: str, otherwise: Any) -> Any:
    from vpd_lightning.data.recorded_scene import recorded  # loads h5py, which most commands do without

    return recorded(folder, name, otherwise)


def find_recipe(folders: Sequence[Path], size: str, model: str) -> str:
    """Return the option of ``conf/recipe`` for a model at a size: its own, or the one of every model without."""
    is_own = any((folder / "recipe" / size / f"{model}.yaml").is_file() for folder in folders)
    return f"{size}/{model if is_own else _EVERY_MODEL}"
