"""From a checked configuration to objects: the only call of ``instantiate``, behind a list of what may be built."""

import inspect
import types
import typing
from collections.abc import Mapping, Sequence, Set
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

from hydra.errors import InstantiationException
from hydra.utils import instantiate

from vpd_lightning.config.plugins import load_plugins
from vpd_lightning.errors import ConfigError, VPDError

if TYPE_CHECKING:
    from vpd_lightning.system import AbstractSystem

# Only classes defined below these packages may be built; see also the packages of loaded plug-ins.
SYSTEM_PACKAGES = ("vpd_lightning",)  # a system and its parts, whose description may come from anywhere
ALLOWED_PACKAGES = (*SYSTEM_PACKAGES, "torch.optim", "lightning.pytorch")
WORDS_OF_OUR_OWN = {"trainer.precision": "auto"}
"""Values that no class takes: the command replaces them before anything is built."""
_REFERENCE = "${"
STAGES = {
    "encoder": ("vpd_lightning.encoder.base", "AbstractEncoder"),
    "dynamics": ("vpd_lightning.dynamics.base", "AbstractDynamics"),
    "renderer": ("vpd_lightning.renderer.base", "AbstractRenderer"),
}
WHOLE_SYSTEM = ("vpd_lightning.simulator", "Simulator")
ANY_SYSTEM = ("vpd_lightning.system", "AbstractSystem")


def build(section: Mapping[str, Any], expected: type | None, name: str, **more: Any) -> Any:
    """Build the object that a section describes; ``more`` are constructor arguments that no file can hold.

    Args:
        section: a plain mapping with ``_target_`` and one key per constructor argument.
        expected: abstract class that the object must be an instance of.
        name: where the section stands, for messages.
        more: objects to pass beside the section's values.

    Raises:
        ConfigError: a class that may not be built, an unknown, missing or mistyped argument, or a value that the
            constructor refuses.
    """
    return _build(section, expected, name, more, ALLOWED_PACKAGES)


def _build(
    section: Mapping[str, Any], expected: type | None, name: str, more: Mapping[str, Any], packages: Sequence[str]
) -> Any:
    refuse_references(section, name)
    _check_targets(section, name, more, packages)
    target = resolve_class(section["_target_"], name, packages)
    if expected is not None and not issubclass(target, expected):
        raise ConfigError(f"{name}._target_ is {section['_target_']}.\nIt must be a kind of {expected.__name__}.")
    try:
        built = instantiate(dict(section), _convert_="all", **more)
    except InstantiationException as error:
        raise _explain_failure(error, name) from error
    if expected is not None and not isinstance(built, expected):
        raise ConfigError(f"{name} built a {type(built).__name__}.\nIt must be a kind of {expected.__name__}.")
    return built


def build_list(section: Mapping[str, Any] | None, expected: type | None, name: str) -> list[Any]:
    """Build every entry of a section of named entries; entries that are null are left out."""
    entries = {key: entry for key, entry in (section or {}).items() if entry is not None}
    return [build(entry, expected, f"{name}.{key}") for key, entry in entries.items()]


def build_simulator(config: Mapping[str, Any]) -> "AbstractSystem":
    """Build the system of a plain configuration: from model, encoder, dynamics and renderer, or from model alone.

    The configuration may come from a checkpoint: it is data, and goes through the same checks; of other packages than
    ours and plug-ins nothing is built.

    Raises:
        ConfigError: see ``build``; also stages whose widths do not fit together.
    """
    if not isinstance(config.get("model"), Mapping):
        raise ConfigError("the configuration has no section model.")
    if not is_of_stages(config):
        whole = getattr(import_module(ANY_SYSTEM[0]), ANY_SYSTEM[1])
        return _build(config["model"], whole, "model", {}, SYSTEM_PACKAGES)
    missing = [key for key in STAGES if not isinstance(config.get(key), Mapping)]
    if missing:
        raise ConfigError(f"the configuration has no section {' and no section '.join(missing)}.")
    for name, (module, base) in STAGES.items():
        _check_kind(config[name], name, module, base)
    check_widths(config)
    stages = {
        name: _build(config[name], getattr(import_module(module), base), name, {}, SYSTEM_PACKAGES)
        for name, (module, base) in STAGES.items()
    }
    module, base = WHOLE_SYSTEM
    return _build(config["model"], getattr(import_module(module), base), "model", stages, SYSTEM_PACKAGES)


def is_of_stages(config: Mapping[str, Any]) -> bool:
    """Whether the system is made of encoder, dynamics and renderer (else its section ``model`` says everything)."""
    section = config["model"]
    if "_target_" not in section:
        raise ConfigError("model names no class.\nIts section needs a key _target_.")
    module, base = WHOLE_SYSTEM
    return issubclass(
        resolve_class(section["_target_"], "model", SYSTEM_PACKAGES), getattr(import_module(module), base)
    )


def check_widths(config: Mapping[str, Any]) -> None:
    """Check that all stages agree on the width of particle features, and on whether these hold colours.

    Raises:
        ConfigError: they do not.
    """
    sections = {name: config.get(name) or {} for name in STAGES}
    widths = {f"{name}.feature_dim": part["feature_dim"] for name, part in sections.items() if "feature_dim" in part}
    channels = sections["encoder"].get("channels")
    if channels:
        widths["encoder.channels[-1]"] = channels[-1]
    if len(set(widths.values())) > 1:
        listed = ", ".join(f"{key}={value}" for key, value in widths.items())
        raise ConfigError(
            f"the stages disagree on the width of particle features.\n{listed}.\n"
            "Set feature_dim=N at the root; all stages follow it."
        )
    colored = {name: part["color_features"] for name, part in sections.items() if "color_features" in part}
    if len(set(colored.values())) > 1:
        listed = ", ".join(f"{name}.color_features={str(value).lower()}" for name, value in colored.items())
        raise ConfigError(
            f"the stages disagree on whether features hold colours.\n{listed}.\n"
            "Set color_features=true or false at the root; all stages follow it."
        )


def check_targets(node: Any, name: str, given: Mapping[str, Any] | None = None) -> None:
    """Check every class named below ``node`` and the arguments given to it, without building anything.

    Raises:
        ConfigError: a class that may not be built, an unknown, missing or mistyped argument, or a reference (``${``):
            configurations are resolved before, and ``instantiate`` would resolve this one after the check, to anything.
    """
    refuse_references(node, name)
    _check_targets(node, name, given or {}, ALLOWED_PACKAGES)


def _check_targets(node: Any, name: str, given: Mapping[str, Any], packages: Sequence[str]) -> None:
    if isinstance(node, Mapping):
        if "_target_" in node:
            _check_arguments(resolve_class(node["_target_"], name, packages), node, name, given)
        for key, value in node.items():
            _check_targets(value, f"{name}.{key}", {}, packages)
    elif isinstance(node, Sequence) and not isinstance(node, str):
        for index, value in enumerate(node):
            _check_targets(value, f"{name}[{index}]", {}, packages)


def refuse_references(node: Any, name: str) -> None:
    """Refuse every string below ``node``, keys included, that something would resolve (``${``).

    Raises:
        ConfigError: there is one.
    """
    if isinstance(node, str) and _REFERENCE in node:
        raise ConfigError(
            f"{name} holds a reference (${{...}}), which would be resolved after the check of the allowed classes.\n"
            f"Given: {node[:80]!r}. Write the value itself."
        )
    if isinstance(node, Mapping):
        for key, value in node.items():
            refuse_references(key, name)
            refuse_references(value, f"{name}.{key}")
    elif isinstance(node, Sequence | Set) and not isinstance(node, str | bytes):
        for index, value in enumerate(node):
            refuse_references(value, f"{name}[{index}]")


def _check_kind(section: Mapping[str, Any], name: str, module: str, base: str) -> None:
    if "_target_" not in section:
        raise ConfigError(f"{name} names no class.\nIts section needs a key _target_.")
    target = resolve_class(section["_target_"], name, SYSTEM_PACKAGES)
    if not issubclass(target, getattr(import_module(module), base)):
        raise ConfigError(f"{name}._target_ is {section['_target_']}.\nIt must be a kind of {base}.")


def _is_below(path: str, packages: Sequence[str]) -> bool:
    return any(path.startswith(f"{package}.") for package in packages)


def resolve_class(target: Any, name: str, packages: Sequence[str]) -> type:
    """Return the class behind a dotted path; its own module must be allowed too, not only the path that leads there."""
    allowed = (*packages, *load_plugins().packages)
    refusal = ConfigError(
        f"{name}._target_={target} may not be built.\n"
        f"Allowed are classes of {', '.join(allowed)}.\n"
        "Another package joins through the entry-point group vpd_lightning.plugins."
    )
    if not isinstance(target, str) or not _is_below(target, allowed):
        raise _missing_plugin(target, name) or refusal
    found = _locate(target, name)
    if not isinstance(found, type) or not _is_below(f"{found.__module__}.", allowed):
        raise refusal
    return found


def _missing_plugin(target: Any, name: str) -> ConfigError | None:
    """Return the error for a class of a package that is not installed; nothing is imported.

    No command to install it by that name: the name may be misspelt, or come from whoever sent the checkpoint.
    """
    package = target.partition(".")[0] if isinstance(target, str) else ""
    if "." not in str(target) or not package.isidentifier() or find_spec(package) is not None:
        return None
    return ConfigError(
        f"{name}._target_={target} may not be built: the plug-in {package} is not installed here.\n"
        "Check the name; or install it, if you trust where it comes from (its source: pip install -e FOLDER)."
    )


def _locate(target: str, name: str) -> Any:
    words = target.split(".")
    if not all(word.isidentifier() for word in words):
        raise ConfigError(f"{name}._target_={target} is not the dotted name of a class.")
    for length in range(len(words) - 1, 0, -1):
        path = ".".join(words[:length])
        try:
            found: Any = import_module(path)
        except ModuleNotFoundError as error:
            if error.name and (path == error.name or path.startswith(f"{error.name}.")):
                continue  # the path is longer than the module
            if (error.name or "").partition(".")[0] == "vpd_lightning":
                raise  # our own fault, not the configuration's
            raise ConfigError(
                f"{name} needs {error.name}, which is not installed.\n"
                f"pip install {(error.name or '').partition('.')[0]}, or choose another {name.partition('.')[0]}."
            ) from error
        for word in words[length:]:
            if not hasattr(found, word):
                near = get_close_matches(word, dir(found), n=1)
                hint = f"Did you mean {path}.{near[0]}?" if near else "Check the name."
                raise ConfigError(f"{name}._target_={target} does not exist.\n{hint}")
            found = getattr(found, word)
        return found
    raise ConfigError(f"{name}._target_={target} does not exist.\nCheck the name.")


def _check_arguments(target: type, section: Mapping[str, Any], name: str, given: Mapping[str, Any]) -> None:
    parameters = dict(inspect.signature(target).parameters)
    takes_any = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    named = {key: p for key, p in parameters.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    hints = _hints(target)
    for key, value in section.items():
        if key == "_target_":
            continue
        if not isinstance(key, str) or key.startswith("_"):
            raise ConfigError(f"{name}.{key} is not allowed.\nBeside _target_, a section holds plain arguments only.")
        if key not in named and not takes_any:
            near = get_close_matches(key, named, n=1)
            hint = f"Did you mean {name}.{near[0]}?" if near else f"It takes: {', '.join(named)}."
            raise ConfigError(f"there is no key {name}.{key}: {target.__name__} takes no such argument.\n{hint}")
        if WORDS_OF_OUR_OWN.get(f"{name}.{key}") == value and value is not None:
            continue
        if not isinstance(value, Mapping) and not fits(value, hints.get(key, Any)):
            own = WORDS_OF_OUR_OWN.get(f"{name}.{key}")
            wanted = _spell(hints[key]) + (f" or {own}" if own else "")
            raise ConfigError(f"{name}.{key} has the wrong type.\nGiven: {value!r}. {target.__name__} wants {wanted}.")
    absent = [key for key, p in named.items() if p.default is p.empty and key not in section and key not in given]
    if absent and not (name == "model" and set(absent) <= set(STAGES)):
        raise ConfigError(f"{name} lacks {', '.join(absent)}.\n{target.__name__} needs a value for each.")


def _hints(target: type) -> dict[str, Any]:
    try:
        return typing.get_type_hints(target.__init__)  # type: ignore[misc]
    except (NameError, TypeError):  # names known to type checkers only
        return {}


def fits(value: Any, hint: Any) -> bool:
    """Whether a plain value fits a type hint; hints that say nothing about plain values fit everything."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any or isinstance(hint, typing.TypeVar | str):
        return True
    if origin in (Union, types.UnionType):
        return any(fits(value, option) for option in arguments)
    if hint is None or hint is type(None):
        return value is None
    if origin is Literal:
        return value in arguments
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    container = origin or hint
    if not isinstance(container, type):
        return True
    if issubclass(container, Mapping):
        return isinstance(value, Mapping)
    if issubclass(container, tuple) and isinstance(value, list | tuple):
        return True
    if container is not str and issubclass(list, container) and container is not object:
        inner = arguments[0] if arguments else Any
        return isinstance(value, list | tuple) and all(fits(item, inner) for item in value if not _is_section(item))
    return isinstance(value, container)


def _is_section(value: Any) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def _spell(hint: Any) -> str:
    words = {int: "a whole number", float: "a number", str: "a word", bool: "true or false", type(None): "null"}
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(_spell(option) for option in get_args(hint))
    if get_origin(hint) is Literal:
        return ", ".join(map(str, get_args(hint)))
    if get_origin(hint) is not None and get_args(hint) and issubclass(list, get_origin(hint)):
        return f"a list of ({_spell(get_args(hint)[0])})"
    return words.get(hint) or str(getattr(hint, "__name__", hint))


def _explain_failure(error: InstantiationException, name: str) -> VPDError:
    """Keep our own errors; call what a constructor refuses by the section's name."""
    cause = error.__cause__
    while cause is not None and isinstance(cause, InstantiationException):
        cause = cause.__cause__
    if isinstance(cause, VPDError):
        return cause
    if isinstance(cause, ModuleNotFoundError):
        return ConfigError(f"{name} needs the package {cause.name}, which is not installed.\npip install {cause.name}")
    if isinstance(cause, ImportError | ValueError | TypeError):
        return ConfigError(f"{name} cannot be built.\n{cause}")
    if "No supported gpu backend found" in str(cause):  # Lightning's words
        return ConfigError(
            "there is no GPU here that PyTorch can use (vpd-info lists what there is).\nUse trainer=cpu."
        )
    first = str(cause or error).splitlines()[0] if str(cause or error) else type(cause).__name__
    return ConfigError(f"{name} cannot be built.\n{type(cause or error).__name__}: {first}")
