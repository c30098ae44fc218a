"""Errors of Hydra and OmegaConf, rewritten so that a person can act on them."""

import re
from collections.abc import Callable, Iterator, Sequence
from difflib import SequenceMatcher, get_close_matches
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, InterpolationResolutionError, MissingMandatoryValue, ValidationError

from vpd_lightning.errors import ConfigError, VPDError


def refuse_bypasses(overrides: Sequence[str]) -> None:
    """Refuse words that add or remove keys: every key there is has its place in ``conf/``.

    Raises:
        ConfigError: a word begins with ``+`` or ``~``.
    """
    for word in overrides:
        if word.startswith(("+", "~")):
            does = "adds" if word.startswith("+") else "removes"
            raise ConfigError(
                f"'{word}' {does} a key behind the schema's back.\n"
                "Every setting has its place in the configuration; --cfg job lists them all.\n"
                "To set a key that is there, remove the sign; a new option goes into a folder for --config-dir."
            )


def parsed(overrides: Sequence[str]) -> list[Override]:
    """Return the words of a command line as Hydra reads them.

    Raises:
        OverrideParseException: a word cannot be read.
    """
    return OverridesParser.create().parse_overrides(list(overrides))


def explain(
    error: Exception, command: str, overrides: Sequence[str], compose: Callable[[Sequence[str]], Any]
) -> VPDError:
    """Return the error to show for one that came out of composing; ``compose`` composes fewer words."""
    cause = error.__cause__ or error
    text = str(error)
    if isinstance(error, ConfigError):
        return error
    if isinstance(error, OverrideParseException):
        word = str(error.override)
        reason = _for_a_bare_path(word, command) or (
            f"{_first_line(text, skip='Error parsing')}\n"
            f"Write key=value or group=option, without spaces around '=', for example: vpd-{command} seed=1"
        )
        return ConfigError(f"cannot read '{word}'.\n{reason}")
    if isinstance(error, MissingConfigException):
        return _explain_missing_option(error.missing_cfg_file, error.options, overrides)
    unknown = re.search(r"Could not override '([^']+)'", text)  # the exception has no field for it
    if unknown is not None:
        return _explain_unknown_key(unknown[1], cause, overrides, compose)
    if isinstance(cause, ValidationError):
        return _explain_wrong_type(cause)
    if "Config group override must be" in text:
        group = next((w for w in overrides if w.partition("=")[2] in ("", "null") or _is_number(w)), "a group")
        return ConfigError(f"'{group}' does not name an option.\nA group takes the name of one of its files.")
    several = next((word for word in parsed(overrides) if word.is_sweep_override()), None)
    if several is not None:
        return ConfigError(
            f"'{several.input_line}' has several values.\n"
            "For a sweep add -m; for a list write key=[1,2] (quote it for the shell)."
        )
    if isinstance(error, AssertionError | TypeError):  # what OmegaConf does with a key below null, or with a list
        return _explain_unfit_word(overrides, compose)
    if isinstance(error, InterpolationKeyError | InterpolationResolutionError | MissingMandatoryValue):
        return explain_missing_value(error)
    return ConfigError("the configuration cannot be composed.\n" + "\n".join(text.splitlines()[:3]))


def explain_missing_value(error: Exception) -> VPDError:
    """Return the error for a key without a value, or with a reference that leads nowhere."""
    broken = named_cause(error)
    if broken is not None:
        return broken
    key = getattr(error, "full_key", None)
    if isinstance(error, MissingMandatoryValue):
        return ConfigError(f"{key or 'a key'} has no value.\nGive one: {key}=...")
    return ConfigError(f"{key or 'a key'} cannot be resolved.\n{str(error).splitlines()[0]}")


def named_cause(error: BaseException) -> VPDError | None:
    """Return the error of ours behind one of OmegaConf: a value asked for what is in a file, and that is broken."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, VPDError):
        cause = cause.__cause__ or cause.__context__
    return cause


def suggest(word: str, known: Sequence[str]) -> str:
    """Return a sentence with the known words that look like ``word``, or an empty string."""
    close = get_close_matches(word, known, n=3, cutoff=0.6)
    best = SequenceMatcher(None, word, close[0]).ratio() if close else 0.0
    near = [known_word for known_word in close if SequenceMatcher(None, word, known_word).ratio() > best - 0.05]
    return f"Did you mean {' or '.join(near)}?" if near else ""


def keys_of(config: Any, prefix: str = "") -> Iterator[str]:
    """Yield the full name of every key of a composed configuration."""
    if isinstance(config, DictConfig):
        config = OmegaConf.to_container(config, resolve=False)
    if isinstance(config, dict):
        for name, value in config.items():
            yield f"{prefix}{name}"
            yield from keys_of(value, f"{prefix}{name}.")


def _for_a_bare_path(word: str, command: str) -> str:
    """Return the setting that a path without a key was meant for, or an empty string."""
    if "=" in word or not ("/" in word or Path(word).exists()):
        return ""
    key = "data.folder" if command == "train" else "ckpt"
    return f"A setting has a name. Did you mean {key}={word}?"


def _explain_missing_option(path: str | None, options: Sequence[str] | None, overrides: Sequence[str]) -> ConfigError:
    folder = next((word.removeprefix("data=") for word in overrides if word.startswith("data=")), "")
    if (path or "").startswith("data/") and ("/" in folder or Path(folder).is_dir()):
        return ConfigError(
            f"data={folder} names a folder, and data an option of conf/data.\nWrite data.folder={folder}"
        )
    group, _, option = (path or "").rpartition("/")
    guess = suggest(option, options or ())
    if not options:
        names = [word.partition("=")[0] for word in overrides]
        return ConfigError(f"there is no configuration {path}.\nGiven: {' '.join(names) or 'nothing'}.")
    if group == "hydra/launcher" and option.startswith("submitit"):
        return ConfigError(
            f"hydra/launcher={option} is not installed.\npip install 'vpd-lightning[slurm]'; see docs/clusters.md."
        )
    what = "experiment" if group == "experiment" else f"option of {group}"
    listing = f"There are: {', '.join(options)}."
    return ConfigError(f"there is no {what} called {option}.\n{guess or 'Check the name.'}\n{listing}")


def _explain_unknown_key(
    key: str, cause: BaseException, overrides: Sequence[str], compose: Callable[[Sequence[str]], Any]
) -> ConfigError:
    inner = getattr(cause, "full_key", None) or ""
    key = inner if inner.startswith(key) else key
    guess = ""
    try:
        others = [word for word in overrides if "." not in word.partition("=")[0] and not word.startswith(key)]
        if len(others) == len(overrides):  # an option's own fault: fewer words would end here again
            return ConfigError(f"{str(cause).splitlines()[0]}\nThe chosen options are incompatible; remove one.")
        known = list(keys_of(compose(others)))
        if key in known:  # a group that no line of this configuration names
            return ConfigError(
                f"{key} has no effect here: this model has no such stage.\nRemove it, or choose another."
            )
        guess = _nearest_key(key, known)
    except ConfigError:
        pass  # something else is wrong too; the key alone says enough
    return ConfigError(f"there is no key {key}.\n{guess or 'All keys: --cfg job.'}")


def unknown_key(key: str, config: Any) -> ConfigError:
    """Return the error for a key that a composed configuration does not have."""
    return ConfigError(f"there is no key {key}.\n{_nearest_key(key, list(keys_of(config))) or 'All keys: --cfg job.'}")


def _explain_unfit_word(overrides: Sequence[str], compose: Callable[[Sequence[str]], Any]) -> ConfigError:
    """Name the first word that sets a key below one that is null, or below or in place of a section."""
    chosen = [word.input_line for word in parsed(overrides) if isinstance(word.value(), str)]
    config = compose([word for word in chosen if word and "." not in word.partition("=")[0]])
    for word in parsed(overrides):
        key, value = word.key_or_group, word.value()
        section = key.rpartition(".")[0]
        if section and OmegaConf.select(config, section) is None:
            return ConfigError(f"there is no key {key} here: {section} is null.\nChoose an option that fills it.")
        if OmegaConf.is_dict(OmegaConf.select(config, key)) and not isinstance(value, str | dict):
            return ConfigError(f"{key} is a section.\nSet one of its keys, {key}.KEY=VALUE, or {key}={{KEY: VALUE}}.")
    return ConfigError("the arguments do not fit the configuration.\nAll keys and their values: --cfg job.")


def _nearest_key(key: str, known: Sequence[str]) -> str:
    """Suggest, in this order: the section spelt right, a near neighbour, the same word in another section, any key."""
    section, _, leaf = key.rpartition(".")
    for near in get_close_matches(section, sorted({name.rpartition(".")[0] for name in known}), cutoff=0.75):
        if near != section and f"{near}.{leaf}" in known:
            return f"Did you mean {near}.{leaf}?"
    siblings = [name for name in known if name.rpartition(".")[0] == section]
    leaves = {name.rpartition(".")[2]: name for name in siblings}
    close = get_close_matches(leaf, leaves, n=1, cutoff=0.8)
    if close:
        return f"Did you mean {leaves[close[0]]}?"
    elsewhere = [name for name in known if name.rpartition(".")[2] == leaf]
    if elsewhere:
        return f"Did you mean {' or '.join(elsewhere[:3])}?"
    return suggest(key, siblings) or suggest(key, known)


def _explain_wrong_type(cause: ValidationError) -> ConfigError:
    name = cause.full_key or "a key"
    reason = str(cause).splitlines()[0].replace("Integer", "a whole number").replace("Float", "a number")
    return ConfigError(f"{name} has the wrong type.\n{reason.rstrip('.')}.")


def _first_line(text: str, skip: str) -> str:
    lines = [line for line in text.splitlines() if line and not line.startswith((skip, "See "))]
    return lines[0] if lines else ""


def _is_number(word: str) -> bool:
    value = word.partition("=")[2]
    return "." not in word.partition("=")[0] and bool(re.fullmatch(r"-?\d+(\.\d+)?|true|false", value.lower()))
