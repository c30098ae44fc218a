"""From the words of a command line to one checked configuration; all commands with a configuration share this."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from vpd_lightning.commands.help_text import help_text
from vpd_lightning.config.paths import config_folder
from vpd_lightning.errors import ConfigError

# Hydra answers these itself; nothing is run.
_QUESTIONS = {"--help", "-h", "--hydra-help", "--cfg", "-c", "--info", "-i", "--shell-completion", "-sc", "--version"}
_UNSUPPORTED = {
    "--config-path": "--config-dir=FOLDER adds a folder of further options",
    "-cp": "--config-dir=FOLDER adds a folder of further options",
    "--config-name": "choose experiment=NAME",
    "-cn": "choose experiment=NAME",
    "--experimental-rerun": "start again with the overrides in the run folder's overrides.yaml",
}


@dataclass(frozen=True)
class Arguments:
    """A command line, taken apart: ``overrides`` are the words with ``=``, ``why`` is a key to explain."""

    overrides: list[str]
    flags: list[str]
    config_dir: str | None
    is_multirun: bool
    is_question: bool
    why: str | None = None


def parse_arguments(argv: Sequence[str]) -> Arguments:
    """Take a command line apart.

    Raises:
        ConfigError: a flag that is not supported or lacks its value.
    """
    overrides: list[str] = []
    flags: list[str] = []
    config_dir, is_multirun, is_question, why = None, False, False, None
    words = iter(argv)
    for word in words:
        name, _, value = word.partition("=")
        if not word.startswith("-"):
            # A bare word after a flag that takes a value, such as `--cfg job`, belongs to the flag.
            (flags if is_question and "=" not in word else overrides).append(word)
            continue
        if name == "--why":
            is_question, why = True, value or next(words, None)
            if not why:
                raise ConfigError("--why needs a key: --why optimizer.lr")
            continue
        flags.append(word)
        if name in _UNSUPPORTED:
            raise ConfigError(f"{name} is not supported.\nInstead: {_UNSUPPORTED[name]}.")
        if name in ("--config-dir", "-cd"):
            config_dir = value or next(words, None)
            if config_dir is None:
                raise ConfigError("--config-dir needs a folder: --config-dir=FOLDER")
            if not value:
                flags.append(config_dir)
        elif name in ("--multirun", "-m"):
            is_multirun = True
        elif name in _QUESTIONS:
            is_question = True
        elif name in ("--package", "-p"):
            flags += [] if value else [*islice(words, 1)]
        elif name not in ("--resolve", "--run", "-r"):
            raise ConfigError(f"there is no flag {name}.\nSettings are written key=value; --help shows examples.")
    return Arguments(overrides, flags, config_dir, is_multirun, is_question, why)


def configure(command: str, argv: Sequence[str]) -> dict[str, Any] | None:
    """Return the checked configuration of a command, or None where the words asked a question that is now answered.

    Args:
        command: name of the root configuration: ``train``, ``eval``, ``render``.
        argv: the words after the command's name.

    Raises:
        ConfigError: see ``vpd_lightning.config.compose``.
    """
    from vpd_lightning.config import compose

    arguments = parse_arguments(argv)
    if arguments.is_question:
        answer(command, argv)
        return None
    if arguments.is_multirun:
        raise ConfigError(f"vpd-{command} has no sweeps.\nCall it once per value, or sweep with vpd-train -m.")
    return compose(command, arguments.overrides, arguments.config_dir)


def answer(command: str, argv: Sequence[str]) -> None:
    """Answer ``--help``, ``--why`` and ``--version``, and let Hydra answer ``--cfg job``, ``--info`` and the like."""
    from vpd_lightning.config import compose
    from vpd_lightning.config.composing import option_folders

    arguments = parse_arguments(argv)
    if {"--help", "-h"} & set(arguments.flags):
        folders = [config_folder(), *option_folders(arguments.config_dir, arguments.overrides)]
        print(help_text(command, folders))
        return
    if "--version" in arguments.flags:
        from vpd_lightning import __version__

        print(f"vpd-{command} {__version__}")
        return
    if arguments.why is not None:
        from vpd_lightning.config.why import explain_key

        print(explain_key(command, arguments.why, arguments.overrides, arguments.config_dir))
        return
    if any(flag in ("--cfg", "-c") for flag in (flag.partition("=")[0] for flag in arguments.flags)):
        compose(command, arguments.overrides, arguments.config_dir)  # a named error instead of Hydra's
    run_hydra(command, argv, lambda config: None)


def run_hydra(command: str, argv: Sequence[str], task: Callable[[Any], Any]) -> None:
    """Let Hydra compose, make the run folder, set up the log, and call ``task``: once, or per job of a sweep."""
    import hydra

    from vpd_lightning.config import config_folder
    from vpd_lightning.config.composing import plugin_search_path, prepare, whole_schedules

    # Hydra's parser takes settings in one run of words only, and plug-ins add one: flags go in front.
    arguments = parse_arguments(argv)
    prepare(arguments.config_dir, arguments.overrides)
    overrides = whole_schedules(arguments.overrides)
    words = [*arguments.flags, *overrides, *plugin_search_path(arguments.overrides)]
    with _command_line(f"vpd-{command}", words):
        try:
            hydra.main(config_path=str(config_folder()), config_name=command, version_base="1.3")(task)()
        except SystemExit as stop:
            if stop.code not in (None, 0):
                raise


def run_composed(command: str, argv: Sequence[str], config: Any, task: Callable[[Any], Any]) -> None:
    """Make the run folder, set up the log, and call ``task``: as ``run_hydra``, for one run that is composed already.

    Args:
        command: name of the root configuration.
        argv: the words that the configuration comes from.
        config: the configuration with Hydra's own section, as Hydra composes it.
        task: gets the configuration without that section.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.utils import configure_log
    from omegaconf import OmegaConf, open_dict, read_write

    arguments = parse_arguments(argv)
    folder = Path(str(OmegaConf.select(config, "hydra.run.dir"))).absolute()
    with read_write(config), open_dict(config):
        config.hydra.runtime.output_dir = str(folder)
    before = HydraConfig.instance().cfg
    # Lightning looks here when it starts a process for each further device.
    HydraConfig.instance().set_config(config)
    try:
        with _command_line(f"vpd-{command}", [*arguments.flags, *arguments.overrides]):
            folder.mkdir(parents=True, exist_ok=True)
            configure_log(config.hydra.job_logging, config.hydra.verbose)
            task(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"]))
    finally:
        HydraConfig.instance().cfg = before


@contextmanager
def _command_line(name: str, argv: Sequence[str]) -> Iterator[None]:
    """Show Hydra (and Lightning's launcher, which starts the same command for each device) these words."""
    before, errors = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    program = before[0] if before and before[0] else name
    sys.argv = [program, *argv]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # hand exceptions to us instead of printing them
    try:
        yield
    finally:
        sys.argv = before
        if errors is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = errors
