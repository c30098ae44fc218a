"""``--why KEY``: which files set a key, in order, what each gave, and what won."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.default_element import ResultDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Override
from hydra.types import RunMode
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vpd_lightning.config.composing import SCHEMAS, compose_unresolved, initialized, option_folders
from vpd_lightning.config.explaining import unknown_key
from vpd_lightning.config.paths import config_folder

_COMMAND_LINE = "command line"
_REFERENCE = re.compile(r"\$\{([\w.]+)\}")


@dataclass(frozen=True)
class Setting:
    """One place that sets a key, and the value as it stands there."""

    place: str
    value: str


def explain_key(command: str, key: str, overrides: Sequence[str], config_dir: str | Path | None = None) -> str:
    """Return, as text, every place that sets ``key`` in the order in which they count, and the value that won.

    Keys that the winning value refers to follow, and who chose the option that fills the section.

    Raises:
        ConfigError: the words do not compose, or there is no such key.
    """
    config = compose_unresolved(command, overrides, config_dir)
    with initialized(overrides, config_dir) as words:
        loader = GlobalHydra.instance().config_loader()
        composed = loader.compute_defaults_list(command, list(words), RunMode.RUN)
    folders = [config_folder(), *option_folders(config_dir, overrides)]
    files = [_File.of(one, folders) for one in composed.defaults if not str(one.package).startswith("hydra")]
    choices = {name: str(option) for name, option in composed.overrides.known_choices.items()}
    raw = OmegaConf.to_container(config, resolve=False)
    if not _is_there(raw, key) and key not in choices:
        raise unknown_key(key, config)
    composition = _Composition(files, composed.config_overrides, choices, overrides)
    blocks: dict[str, str] = {}
    waiting = [key]
    while waiting:
        name = waiting.pop(0)
        if _is_there(raw, name) and name not in blocks:
            settings = composition.settings(name)
            value = _below(raw, name.split("."))
            blocks[name] = _block(f"{name} = {_spelt(_resolved(config, name, value))}", settings)
            if settings and not isinstance(value, Mapping):
                waiting += _REFERENCE.findall(settings[-1].value)
        for group in composition.groups_of(name):
            title = f"{group} is {choices[group]}"
            if title not in blocks:
                choosers = composition.choosers(group)
                blocks[title] = _block(title, choosers)
                waiting += _REFERENCE.findall(choosers[-1].value if choosers else "")
    return "\n\n".join(blocks.values())


@dataclass(frozen=True)
class _Composition:
    """What Hydra put together: files in the order in which they count, options chosen, words given."""

    files: Sequence["_File"]
    given: Sequence[Override]
    choices: Mapping[str, str]
    words: Sequence[str]

    def settings(self, key: str) -> list[Setting]:
        found = [setting for file in self.files for setting in file.settings(key)]
        for word in self.given:
            content = _nested(str(word.key_or_group), word.value())
            found += [Setting(_COMMAND_LINE, value) for value in _values(content, key)]
        return found

    def groups_of(self, key: str) -> list[str]:
        """Return the groups whose option fills the section that ``key`` is in, or that ``key`` names."""
        packages = {group: group.partition("@")[2] or group for group in self.choices}
        return [group for group, place in packages.items() if key == group or f"{key}.".startswith(f"{place}.")]

    def choosers(self, group: str) -> list[Setting]:
        seen = {file.config_path: file for file in self.files}
        first: list[Setting] = []
        later: list[Setting] = []
        for file in seen.values():
            for is_override, name, option, line in file.choices():
                if name == group:
                    chosen = f"{option} (override)" if is_override else option
                    (later if is_override else first).append(Setting(f"{file.place}:{line}", chosen))
        words = [word.partition("=")[2] for word in self.words if word.partition("=")[0] == group]
        return [*first, *later, *(Setting(_COMMAND_LINE, option) for option in words)]


@dataclass(frozen=True)
class _File:
    """A file of options: where it lies, what it holds, and where in the configuration that goes."""

    config_path: str
    place: str
    package: str
    content: Mapping[str, Any]
    text: str

    @classmethod
    def of(cls, default: ResultDefault, folders: Sequence[Path]) -> "_File":
        path, package = str(default.config_path), str(default.package or "")
        file = next((folder / f"{path}.yaml" for folder in folders if (folder / f"{path}.yaml").is_file()), None)
        if file is None:
            command = path.removesuffix("_schema")
            content: Any = OmegaConf.to_container(OmegaConf.structured(SCHEMAS[command]), resolve=False)
            return cls(path, f"schema of {command}", package, content, "")
        text = file.read_text(encoding="utf-8")
        place = str(file.relative_to(config_folder().parent) if config_folder() in file.parents else file)
        content = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
        content.pop("defaults", None)
        return cls(path, place, package, content, text)

    def settings(self, key: str) -> Iterator[Setting]:
        inside = _nested(self.package, self.content) if self.package else self.content
        names = key.split(".")
        own = names[len(self.package.split(".")) if self.package else 0 :]
        for value in _values(inside, key):
            yield Setting(f"{self.place}:{_line(self.text, own)}" if self.text else self.place, value)

    def choices(self) -> Iterator[tuple[bool, str, str, int]]:
        """Yield from the defaults list: whether it is an override, the group, the option, and the line."""
        root = yaml.compose(self.text) if self.text else None
        lists = [] if root is None else [value.value for name, value in root.value if name.value == "defaults"]
        for item in (item for items in lists for item in items if isinstance(item, yaml.MappingNode)):
            name, option = item.value[0]
            words = name.value.split()
            group = words[-1]
            group = group[1:] if group.startswith("/") else "/".join([*self.config_path.split("/")[:-1], group])
            yield "override" in words[:-1], group, str(option.value), name.start_mark.line + 1


def _nested(key: str, value: Any) -> dict[str, Any]:
    for name in reversed(key.split(".")):
        value = {name: value}
    return value  # type: ignore[no-any-return]


def _values(content: Any, key: str) -> Iterator[str]:
    """Yield what ``content`` gives ``key``: its value, or that of a section above it that is no section here."""
    names = key.split(".")
    for depth, name in enumerate(names):
        if not isinstance(content, Mapping):
            if content != "???":
                yield f"{_spelt(content)} (as {'.'.join(names[:depth])})"
            return
        if name not in content:
            return
        content = content[name]
    if content != "???":
        yield _spelt(content)


def _below(content: Any, names: Sequence[str]) -> Any:
    for name in names:
        content = content[name]
    return content


def _is_there(content: Any, key: str) -> bool:
    try:
        _below(content, key.split("."))
    except (KeyError, TypeError):
        return False
    return True


def _resolved(config: Any, key: str, raw: Any) -> Any:
    """Return the value of a key, or its expression where that refers to what has no value yet, as the run's folder."""
    try:
        value = OmegaConf.select(config, key)
        return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    except OmegaConfBaseException:
        return raw


def _line(text: str, names: Sequence[str]) -> int:
    """Return the line of a key in a YAML file, counted from 1; the first one for what is the whole file."""
    node, line = yaml.compose(text), 1
    for name in names:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        found = next(((key, value) for key, value in pairs if key.value == name), None)
        if found is None:
            break
        line, node = found[0].start_mark.line + 1, found[1]
    return line


def _spelt(value: Any) -> str:
    if isinstance(value, str):
        return value
    return yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False).removesuffix("\n...\n").strip()


def _block(title: str, settings: Sequence[Setting]) -> str:
    width = max((len(setting.place) for setting in settings), default=0)
    lines = [f"  {setting.place:<{width}}  {setting.value}" for setting in settings]
    if len(settings) > 1:
        lines[-1] += "  <- wins, key by key" if settings[-1].value.startswith("{") else "  <- wins"
    return "\n".join([title, *(lines or ["  set nowhere: the schema's default"])])
