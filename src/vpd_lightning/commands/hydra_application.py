"""From the words of a command line to one checked configuration; all commands with a configuration share this."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any

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
    """A command line, taken apart: ``overrides`` are the words with ``=``, ``flags`` the rest."""

    overrides: list[str]
    flags: list[str]
    config_dir: str | None
    is_multirun: bool
    is_question: bool


def parse_arguments(argv: Sequence[str]) -> Arguments:
    """Take a command line apart.

    Raises:
        ConfigError: a flag that is not supported or lacks its value.
    """
    overrides: list[str] = []
    flags: list[str] = []
    config_dir, is_multirun, is_question = None, False, False
    words = iter(argv)
    for word in words:
        name, _, value = word.partition("=")
        if not word.startswith("-"):
            # A bare word after a flag that takes a value, such as `--cfg job`, belongs to the flag.
            (flags if is_question and "=" not in word else overrides).append(word)
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
    return Arguments(overrides, flags, config_dir, is_multirun, is_question)


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
    """Let Hydra answer ``--help``, ``--cfg job``, ``--info`` and the like."""
    from vpd_lightning.config import compose

    arguments = parse_arguments(argv)
    if "--version" in arguments.flags:
        from vpd_lightning import __version__

        print(f"vpd-{command} {__version__}")
        return
    if any(flag in ("--cfg", "-c") for flag in (flag.partition("=")[0] for flag in arguments.flags)):
        compose(command, arguments.overrides, arguments.config_dir)  # a named error instead of Hydra's
    with _options_copied_once():
        run_hydra(command, argv, lambda config: None)


@contextmanager
def _options_copied_once() -> Iterator[None]:
    """Let Hydra list options quickly: for each group of a help text it copies all that it knows, in two seconds.

    What is copied is only read while nothing is overridden, so that one copy will do.
    """
    from hydra._internal.config_loader_impl import ConfigLoaderImpl

    name = "_parse_overrides_and_create_caching_repo"
    original = getattr(ConfigLoaderImpl, name)
    kept: dict[Any, Any] = {}

    def copy_once(loader: Any, config_name: Any, overrides: Any) -> Any:
        if config_name is not None or overrides:
            return original(loader, config_name, overrides)
        if loader not in kept:
            kept[loader] = original(loader, config_name, overrides)
        return kept[loader]

    setattr(ConfigLoaderImpl, name, copy_once)
    try:
        yield
    finally:
        setattr(ConfigLoaderImpl, name, original)


def run_hydra(command: str, argv: Sequence[str], task: Callable[[Any], Any]) -> None:
    """Let Hydra compose, make the run folder, set up the log, and call ``task``: once, or per job of a sweep."""
    import hydra

    from vpd_lightning.config import config_folder
    from vpd_lightning.config.composing import plugin_search_path, prepare

    prepare()
    # Hydra's parser takes settings in one run of words only, and plug-ins add one: flags go in front.
    arguments = parse_arguments(argv)
    words = [*arguments.flags, *arguments.overrides, *plugin_search_path(arguments.overrides)]
    with _command_line(f"vpd-{command}", words):
        try:
            hydra.main(config_path=str(config_folder()), config_name=command, version_base="1.3")(task)()
        except SystemExit as stop:
            if stop.code not in (None, 0):
                raise


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
