"""``vpd-data``: generate, inspect and validate data sets."""

import difflib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError, DataError

HELP = """vpd-data: make, look at and check data sets of posed RGB-D video

  vpd-data generate scene=NAME preset=paper|demo|tiny out=FOLDER [seed=0] [renderer=...] [workers=N] [SETTING=VALUE ...]
      Simulate and render. Resumes where it stopped; the same seed gives the same physics.
      scene     mujoco_block: a block with six colours tossed onto a floor
      preset    paper: the paper's counts and sizes (7 GiB, an hour of CPU); demo: 208 small ones; tiny: seconds
      renderer  auto (EGL, then OSMesa), egl, osmesa, raycast (needs no GL); the preset's by default
      workers   processes; all cores by default; never changes the data
      SETTING   any setting of the preset, for example splits.train=8 camera.num_views=4 block.side=0.2

  vpd-data inspect FOLDER [out=FOLDER]
      Print what is in a data set (or one .h5 file) and draw a contact sheet (into the data set by default).

  vpd-data validate FOLDER
      Check every file, its checksum, and whether depths and poses of the views agree; names each fault.

  vpd-data import SOURCE out=FOLDER
      Not available yet; docs/your_data.md says how to write the format from your own recordings.

Examples
  vpd-data generate scene=mujoco_block preset=demo out=datasets/mujoco_block_demo
  vpd-data generate scene=mujoco_block preset=paper out=datasets/mujoco_block seed=1 workers=8
  vpd-data generate scene=mujoco_block preset=tiny out=/tmp/blocks splits.train=8 renderer=egl
  vpd-data inspect datasets/mujoco_block_demo
  vpd-data validate datasets/mujoco_block_demo

Exit codes: 0 ok, 2 wrong arguments, 3 bad or missing data (or no GL), 5 out of memory, 130 Ctrl-C, 143 SIGTERM.
debug=true adds the traceback to an error.
"""

VERBS = ("generate", "inspect", "validate", "import")


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
        near = _did_you_mean(verb, VERBS)
        raise ConfigError(f"Unknown verb {verb!r}{near}\nVerbs: {', '.join(VERBS)}. See vpd-data --help.")
    places, settings = parse(rest)
    if verb == "generate":
        return _generate(places, settings)
    if verb == "import":
        raise ConfigError(
            "vpd-data import is not available yet.\n"
            "docs/your_data.md describes the files; data.schema.write_trajectory writes them from NumPy arrays."
        )
    return _inspect(places, settings) if verb == "inspect" else _validate(places, settings)


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
        if key in ("out", "scene", "preset", "renderer"):  # text as it stands, also when it looks like a number
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
        overrides=settings,
    )
    return 0


def _inspect(places: Sequence[str], settings: dict[str, Any]) -> int:
    path = _one_place("inspect", places)
    _only("inspect", settings, ("out",))
    from vpd_lightning.data.inspect import describe, draw_contact_sheet

    print(describe(path))
    sheet = draw_contact_sheet(path, Path(settings["out"]) if settings.get("out") else None)
    print(f"contact sheet: {sheet}")
    return 0


def _validate(places: Sequence[str], settings: dict[str, Any]) -> int:
    path = _one_place("validate", places)
    _only("validate", settings, ())
    from vpd_lightning.data.validate import validate_dataset

    faults = validate_dataset(path)
    for fault in faults:
        print(fault)
    if any(fault.is_error for fault in faults):
        raise DataError(f"{path} has {sum(fault.is_error for fault in faults)} faults, listed above.")
    print(f"{path} is valid.")
    return 0


def _one_place(verb: str, places: Sequence[str]) -> Path:
    if len(places) != 1:
        raise ConfigError(f"{verb} takes one folder or .h5 file: vpd-data {verb} datasets/mujoco_block_demo")
    path = Path(places[0]).expanduser()
    if not path.exists():
        raise DataError(f"There is no {path}.\nMake one: vpd-data generate; vpd-data --help says how.")
    return path


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


if __name__ == "__main__":
    sys.exit(main())
