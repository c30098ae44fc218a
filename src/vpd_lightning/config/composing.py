"""From command-line words to one checked, plain configuration."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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

from vpd_lightning.config.building import STAGES
from vpd_lightning.config.effects import refuse_idle_words
from vpd_lightning.config.explaining import explain, explain_missing_value, named_cause, refuse_bypasses
from vpd_lightning.config.paths import config_folder
from vpd_lightning.config.plugins import load_plugins
from vpd_lightning.config.resolvers import register_resolvers
from vpd_lightning.config.schema import (
    BenchConfig,
    EvalConfig,
    ExportConfig,
    PlanConfig,
    RenderConfig,
    TrainConfig,
    ViewConfig,
    check_scene,
    check_training,
)
from vpd_lightning.errors import ConfigError

_FORMER_GROUPS = ("stages", "tuning", "per_scene", "spacing")
_ABOVE_THE_RECIPE = ("model", "experiment", "budget")
SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "eval": EvalConfig,
    "render": RenderConfig,
    "view": ViewConfig,
    "bench": BenchConfig,
    "export": ExportConfig,
    "plan": PlanConfig,
}


def prepare(config_dir: str | Path | None = None, overrides: Sequence[str] = ()) -> None:
    """Load plug-ins, register the schemas and the resolvers; safe to call again.

    Raises:
        ConfigError: see ``option_folders``.
    """
    register_resolvers([config_folder(), *option_folders(config_dir, overrides)])
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
    return _composed(command, overrides, config_dir)[2]


def compose_with_folder(
    overrides: Sequence[str], config_dir: str | Path | None, folder: str
) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Return the configuration of ``vpd-train`` as ``compose`` does, as it is once it has a run folder, and for Hydra.

    Composing takes most of the time until a training starts, and the two differ in what refers to the folder alone.

    Args:
        overrides: words as on the command line.
        config_dir: a folder with further options (``--config-dir``).
        folder: the run folder of the second configuration where the first one has none.

    Raises:
        ConfigError: see ``compose``.
    """
    whole, config, result = _composed("train", overrides, config_dir)
    if result["run"]["folder"]:
        return result, result, whole
    config.run.folder = folder
    return result, plain(config), whole


def _composed(command: str, overrides: Sequence[str], config_dir: str | Path | None) -> tuple[Any, Any, dict[str, Any]]:
    """Return the configuration as Hydra made it, with its own section and without, and the plain and checked one."""
    whole = compose_unresolved(command, overrides, config_dir, with_hydra=True)
    config = OmegaConf.masked_copy(whole, [key for key in whole if key != "hydra"])
    schema = SCHEMAS.get(command)
    if schema is not None:
        _check_again(schema, config)
    result = plain(config)
    if command == "train":
        check_scene(result["scene"])
        check_training(result)
        if result["resume"] is None:  # words of an older run stay as they are
            refuse_idle_words(config, result, overrides, [config_folder(), *option_folders(config_dir, overrides)])
    return whole, config, result


def compose_unresolved(
    command: str, overrides: Sequence[str], config_dir: str | Path | None = None, *, with_hydra: bool = False
) -> Any:
    """Return the configuration as Hydra made it, with its references.

    Raises:
        ConfigError: an unknown key, option or type, or a bypass of the schema.
    """
    prepare(config_dir, overrides)
    refuse_bypasses(overrides)
    if command == "train":
        _refuse_stage_settings(overrides, option_folders(config_dir, overrides))
    return _compose(command, overrides, config_dir, with_hydra=with_hydra)


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
    prepare(config_dir, overrides)
    parser = OverridesParser.create()
    fixed = [word for word in overrides if not parser.parse_override(word).is_sweep_override()]
    config = _compose(command, fixed, config_dir, with_hydra=True)
    return [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]


def _compose(command: str, overrides: Sequence[str], config_dir: str | Path | None, *, with_hydra: bool = False) -> Any:
    try:
        with initialized(overrides, config_dir) as words:
            return hydra_compose(command, words, return_hydra_config=with_hydra)
    except (HydraException, OmegaConfBaseException, ValueError, AssertionError, TypeError) as error:
        raise explain(error, command, overrides, lambda fewer: _compose(command, fewer, config_dir)) from error


@contextmanager
def initialized(overrides: Sequence[str], config_dir: str | Path | None) -> Iterator[list[str]]:
    """Initialize Hydra and yield the words for it; leaves a Hydra that is already running (a job of its own) alone."""
    words = [*whole_schedules(overrides), *_search_path(option_folders(config_dir), overrides)]
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            yield words
    finally:
        GlobalHydra.instance().hydra = running


def option_folders(config_dir: str | Path | None, overrides: Sequence[str] = ()) -> list[Path]:
    """Return the folders of options that are not ours: of ``--config-dir``, of plug-ins, of ``hydra.searchpath``.

    Raises:
        ConfigError: the folder does not exist, or holds a group that is no more.
    """
    folders = list(load_plugins().config_folders)
    if config_dir is not None:
        if not Path(config_dir).is_dir():
            raise ConfigError(f"the configuration folder {config_dir} does not exist.\nIt was given by --config-dir.")
        folders.insert(0, Path(config_dir).resolve())
    searched = (word for word in overrides if word.startswith("hydra.searchpath="))
    folders += [Path(folder) for word in searched for folder in re.findall(r"file://([^'\",\]]+)", word)]
    for folder in folders:
        gone = next((group for group in _FORMER_GROUPS if (folder / group).is_dir()), None)
        if gone is not None:
            raise ConfigError(
                f"{folder / gone} would have no effect: there is no group {gone} any more.\n"
                "The stages of a model at one size, and how they are trained, are set in recipe/SIZE/MODEL.yaml."
            )
    return folders


def whole_schedules(overrides: Sequence[str]) -> list[str]:
    """Return the words with a schedule set to null before each that gives one.

    Hydra merges a mapping with the one that is there already: entries of the recipe's schedule would stay between those
    of the command line, or be refused.
    """
    words = []
    for word in overrides:
        key, _, value = word.partition("=")
        words += [f"{key}=null", word] if key.endswith(".num_steps_schedule") and "{" in value else [word]
    return words


def plugin_search_path(overrides: Sequence[str]) -> list[str]:
    """Return the word that shows Hydra the configuration folders of plug-ins, or nothing where there are none."""
    return _search_path(load_plugins().config_folders, overrides)


def _refuse_stage_settings(overrides: Sequence[str], folders: Sequence[Path]) -> None:
    """Refuse files of others that set what the recipe below them overwrites: settings of a stage."""
    for group, _, option in (word.partition("=") for word in overrides):
        for path in (folder / group / f"{option}.yaml" for folder in folders if group in _ABOVE_THE_RECIPE):
            stage = next((name for name in STAGES if path.is_file() and name in OmegaConf.load(path)), None)
            if stage is not None:
                raise ConfigError(
                    f"{path} sets values of {stage}, which the model's recipe for this size would overwrite.\n"
                    f"Move them to an option file {stage}/mine.yaml, and select it: override /{stage}: mine"
                )


def _search_path(folders: Sequence[Path], overrides: Sequence[str]) -> list[str]:
    if not folders or any(word.startswith("hydra.searchpath=") for word in overrides):
        return []  # the user's own list wins
    return ["hydra.searchpath=[" + ",".join(f"'file://{folder}'" for folder in folders) + "]"]


def _check_again(schema: type, config: Any) -> None:
    """Merge the plain container into the empty schema: the only merge that refuses keys added behind its back."""
    try:
        OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.to_container(config))
    except OmegaConfBaseException as error:
        refused = ConfigError(f"the configuration does not fit its schema.\n{str(error).splitlines()[0]}")
        raise (named_cause(error) or refused) from error
