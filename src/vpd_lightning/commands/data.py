"""``vpd-data``: generate, import, inspect, validate and split data sets."""

import difflib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.data_help import HELP
from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError, DataError

_TEXT_SETTINGS = ("out", "scene", "preset", "renderer", "format", "mapping", "pixel_center", "up", "sensor", "shard")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    if not words or any(word in ("-h", "--help", "help", "help=true") for word in words):
        print(HELP)
        return 0 if words else ConfigError.exit_code
    verb, *rest = words
    if verb not in VERBS:
        near = _did_you_mean(verb, tuple(VERBS))
        raise ConfigError(f"Unknown verb {verb!r}{near}\nVerbs: {', '.join(VERBS)}. See vpd-data --help.")
    return VERBS[verb](*parse(rest))


def parse(words: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Split arguments into plain words and ``key=value`` settings (values as YAML; a key given twice is refused)."""
    from omegaconf import OmegaConf
    from yaml import YAMLError

    places: list[str] = []
    settings: dict[str, Any] = {}
    for word in words:
        if word.startswith("-"):
            raise ConfigError(f"Unknown option {word!r}. Settings are written key=value; see vpd-data --help.")
        key, equals, value = word.partition("=")
        if not equals:
            places.append(word)
            continue
        if key in settings:
            raise ConfigError(f"{key} is given twice.")
        if key in _TEXT_SETTINGS:  # text as it stands, also when it looks like a number
            settings[key] = value
            continue
        try:
            node = OmegaConf.to_container(OmegaConf.from_dotlist([f"value={value}"]))
        except (YAMLError, ValueError) as error:
            raise ConfigError(f"{word!r} cannot be read: {' '.join(str(error).split())[:200]}") from error
        assert isinstance(node, dict)
        settings[key] = node["value"]
    settings.pop("debug", None)
    return places, settings


def _generate(places: Sequence[str], settings: dict[str, Any]) -> int:
    if places:
        raise ConfigError(f"generate takes key=value settings only, not {places[0]!r}. See vpd-data --help.")
    missing = [key for key in ("scene", "preset", "out") if not settings.get(key)]
    if missing:
        raise ConfigError(
            f"generate needs {', '.join(key + '=...' for key in missing)}.\n"
            "For example: vpd-data generate scene=mujoco_block preset=demo out=datasets/mujoco_block_demo"
        )
    from data_gen.generate import generate

    generate(
        scene=settings.pop("scene"),
        preset=settings.pop("preset"),
        out=settings.pop("out"),
        seed=_whole_number("seed", settings.pop("seed", 0)),
        renderer=settings.pop("renderer", None),
        workers=_whole_number("workers", settings.pop("workers")) if "workers" in settings else None,
        sensor=settings.pop("sensor", "none"),
        shard=settings.pop("shard", None),
        overrides=settings,
    )
    return 0


def _import(places: Sequence[str], settings: dict[str, Any]) -> int:
    if len(places) != 1 or not settings.get("out"):
        raise ConfigError("import takes one source and a folder to write:\n  vpd-data import SOURCE out=datasets/NAME")
    from data_gen.importers.run import import_recordings

    import_recordings(places[0], settings.pop("out"), settings, settings.pop("shard", None))
    return 0


def _inspect(places: Sequence[str], settings: dict[str, Any]) -> int:
    path = _one_place("inspect", places)
    _only("inspect", settings, ("out",))
    from data_gen.inspection.inspect import describe, draw_mask, files_of, inspect_dataset
    from vpd_lightning.runs.moving_pixels import find_moving_pixels

    print(describe(path))
    out = Path(settings["out"]) if settings.get("out") else None
    drawn = inspect_dataset(path, out)
    first = files_of(path)[0]
    found = find_moving_pixels(first)
    print("\n".join(found.summary()))
    drawn.append(draw_mask(first, out or drawn[0].parent, found.times, found.moving))
    for picture in drawn:
        print(f"wrote          {picture}")
    return 0


def _validate(places: Sequence[str], settings: dict[str, Any]) -> int:
    path = _one_place("validate", places)
    _only("validate", settings, ())
    from data_gen.inspection.validate import check_dataset
    from vpd_lightning.data.manifest import load_manifest
    from vpd_lightning.data.verdict import keep_verdict

    report = check_dataset(path)
    is_whole = path.is_dir() and not any(fault.name == "manifest" for fault in report.faults)
    if is_whole and (reason := keep_verdict(load_manifest(path), report.faults)):
        print(f"remark: {reason}")
    for fault in report.faults:
        print(fault)
    if report.summary:
        print(report.summary)
    num_errors = sum(fault.is_error for fault in report.faults)
    if num_errors:
        raise DataError(f"{path} has {num_errors} fault{'s' * (num_errors > 1)}, listed above.")
    is_sure = not any(fault.name == "cannot_tell" for fault in report.faults)
    print(f"{path} is valid{'.' if is_sure else ', as far as could be checked: see the remarks above.'}")
    return 0


def _split(places: Sequence[str], settings: dict[str, Any]) -> int:
    path = _one_place("split", places)
    _only("split", settings, ("train", "validation", "test", "seed"))
    from data_gen.inspection.split import split_dataset

    result = split_dataset(path, **settings)
    for name, count in result.num_trajectories.items():
        print(f"{name:11}{count} trajectories of {result.num_recordings[name]} recordings")
    return 0


def _one_place(verb: str, places: Sequence[str]) -> Path:
    if len(places) != 1:
        raise ConfigError(f"{verb} takes one folder or .h5 file: vpd-data {verb} datasets/mujoco_block_demo")
    path = Path(places[0]).expanduser()
    if not path.exists():
        from vpd_lightning.data.manifest import did_you_mean

        raise DataError(
            f"There is no {path}.{did_you_mean(path)}\n"
            "Make one: vpd-data generate, or vpd-data import from a recording; vpd-data --help says how."
        )
    _refuse_recording(path)
    return path


def _refuse_recording(path: Path) -> None:
    """Say of a folder that is no data set, but that could become one, how it does."""
    from vpd_lightning.data.manifest import FILE_NAME, UNFINISHED_NAME

    if not path.is_dir() or any((path / name).is_file() for name in (FILE_NAME, UNFINISHED_NAME)):
        return
    from data_gen.importers.formats import matching_formats

    found = matching_formats(path)
    if found:
        raise DataError(
            f"{path} is a recording ({' or '.join(found)}) and not a data set yet.\n"
            f"Import it first: vpd-data import {path} out=datasets/{path.resolve().name}"
        )


def _only(verb: str, settings: dict[str, Any], known: Sequence[str]) -> None:
    for key in settings:
        if key not in known:
            raise ConfigError(f"{verb} has no setting {key!r}{_did_you_mean(key, known)} See vpd-data --help.")


def _whole_number(key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(f"{key} is {value!r}; a whole number is needed.")
    return value


def _did_you_mean(value: str, choices: Sequence[str]) -> str:
    near = difflib.get_close_matches(value, choices, n=1)
    return f"; did you mean {near[0]!r}?" if near else "."


VERBS: dict[str, Callable[[Sequence[str], dict[str, Any]], int]] = {
    "generate": _generate,
    "import": _import,
    "inspect": _inspect,
    "validate": _validate,
    "split": _split,
}


if __name__ == "__main__":
    sys.exit(main())
