"""From command-line words to one checked, plain configuration."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vpd_lightning.config.explaining import explain, explain_missing_value, refuse_bypasses
from vpd_lightning.config.paths import config_folder
from vpd_lightning.config.plugins import load_plugins
from vpd_lightning.config.run_folders import register_resolvers
from vpd_lightning.config.schema import (
    BenchConfig,
    EvalConfig,
    ExportConfig,
    RenderConfig,
    TrainConfig,
    ViewConfig,
    check_scene,
    check_training,
)
from vpd_lightning.errors import ConfigError

SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "eval": EvalConfig,
    "render": RenderConfig,
    "view": ViewConfig,
    "bench": BenchConfig,
    "export": ExportConfig,
}


def prepare() -> None:
    """Load plug-ins, register the schemas and the resolvers; safe to call again."""
    load_plugins()
    register_resolvers()
    for command, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=f"{command}_schema", node=schema)


def compose(command: str, overrides: Sequence[str], config_dir: str | Path | None = None) -> dict[str, Any]:
    """Return the plain, resolved and checked configuration of a command.

    Args:
        command: name of the root, ``conf/<command>.yaml``.
        overrides: words as on the command line, ``key=value`` or ``group=option``.
        config_dir: a folder with further options (``--config-dir``).

    Raises:
        ConfigError: an unknown key, option or type, a value out of range, or a bypass of the schema.
    """
    return _composed(command, overrides, config_dir)[1]


def compose_with_folder(
    overrides: Sequence[str], config_dir: str | Path | None, folder: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the configuration of ``vpd-train`` as ``compose`` does, and as it is once it has a run folder.

    Composing takes most of the time until a training starts, and the two differ in what refers to the folder alone.

    Args:
        overrides: words as on the command line.
        config_dir: a folder with further options (``--config-dir``).
        folder: the run folder of the second configuration where the first one has none.

    Raises:
        ConfigError: see ``compose``.
    """
    config, result = _composed("train", overrides, config_dir)
    if result["run"]["folder"]:
        return result, result
    config.run.folder = folder
    return result, plain(config)


def _composed(command: str, overrides: Sequence[str], config_dir: str | Path | None) -> tuple[Any, dict[str, Any]]:
    """Return the configuration as Hydra made it, and the plain and checked one."""
    prepare()
    refuse_bypasses(overrides)
    config = _compose(command, overrides, config_dir)
    schema = SCHEMAS.get(command)
    if schema is not None:
        _check_again(schema, config)
    result = plain(config)
    if "scene" in result:
        check_scene(result["scene"])
    if command == "train":
        check_training(result)
    return config, result


def plain(config: Any) -> dict[str, Any]:
    """Return the configuration as resolved dictionaries, lists and scalars: what a checkpoint may hold.

    Raises:
        ConfigError: a value is missing, or refers to one that is not there.
    """
    try:
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise explain_missing_value(error) from error


def expand_sweep(command: str, overrides: Sequence[str], config_dir: str | Path | None = None) -> list[list[str]]:
    """Return the overrides of every job of a sweep, in the order of Hydra's own sweeper.

    As there, what the configuration lists under ``hydra.sweeper.params`` (a file of ``conf/sweep`` does) comes first,
    and a word of the same key on the command line replaces it.

    Raises:
        ConfigError: a word cannot be read, or bypasses the schema.
    """
    refuse_bypasses(overrides)
    try:
        parser = OverridesParser.create()
        words = [*sweep_parameters(command, overrides, config_dir), *overrides]
        refuse_bypasses(words)
        jobs = [override for override in parser.parse_overrides(words) if not override.is_hydra_override()]
        return BasicSweeper.split_arguments(jobs, max_batch_size=None)[0]
    except HydraException as error:
        raise explain(error, command, overrides, lambda words: _compose(command, words, config_dir)) from error


def sweep_parameters(command: str, overrides: Sequence[str], config_dir: str | Path | None = None) -> list[str]:
    """Return what the configuration itself lists under ``hydra.sweeper.params``, as words of a command line.

    Raises:
        ConfigError: the words that are the same for all jobs cannot be composed.
    """
    prepare()
    parser = OverridesParser.create()
    fixed = [word for word in overrides if not parser.parse_override(word).is_sweep_override()]
    config = _compose(command, fixed, config_dir, with_hydra=True)
    return [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]


def _compose(command: str, overrides: Sequence[str], config_dir: str | Path | None, *, with_hydra: bool = False) -> Any:
    """Compose with Hydra; leaves a Hydra that is already running (a job of its own) as it was."""
    folders = [str(folder) for folder in load_plugins().config_folders]
    if config_dir is not None:
        if not Path(config_dir).is_dir():
            raise ConfigError(f"the configuration folder {config_dir} does not exist.\nIt was given by --config-dir.")
        folders.insert(0, str(Path(config_dir).resolve()))
    words = [*overrides, *_search_path(folders, overrides)]
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            return hydra_compose(command, words, return_hydra_config=with_hydra)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise explain(error, command, overrides, lambda fewer: _compose(command, fewer, config_dir)) from error
    finally:
        GlobalHydra.instance().hydra = running


def plugin_search_path(overrides: Sequence[str]) -> list[str]:
    """Return the word that shows Hydra the configuration folders of plug-ins, or nothing where there are none."""
    return _search_path([str(folder) for folder in load_plugins().config_folders], overrides)


def _search_path(folders: Sequence[str], overrides: Sequence[str]) -> list[str]:
    if not folders or any(word.startswith("hydra.searchpath=") for word in overrides):
        return []  # the user's own list wins
    return ["hydra.searchpath=[" + ",".join(f"'file://{folder}'" for folder in folders) + "]"]


def _check_again(schema: type, config: Any) -> None:
    """Merge the plain container into the empty schema: the only merge that refuses keys added behind its back."""
    try:
        OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.to_container(config))
    except OmegaConfBaseException as error:
        raise ConfigError(f"the configuration does not fit its schema.\n{str(error).splitlines()[0]}") from error
