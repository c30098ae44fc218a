"""``vpd-info``: versions, devices and backends, and what is missing with the command that installs it."""

import importlib.util
import json
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError, RenderingBackendError
from vpd_lightning.metrics.registry import HEADLINE, metric
from vpd_lightning.release.release_folder import list_releases
from vpd_lightning.runs.environment import DISTRIBUTION, devices, git_commit, requirements, version_of

HELP = """vpd-info - what this installation has, what it lacks, and the released models in ./released

Usage: vpd-info [--json]

Examples:
  vpd-info                 a report for people, and for bug tickets
  vpd-info --json          the same for programs
  vpd-info | grep missing  what could be installed beside it
  python -m vpd_lightning.commands.info
  VPD_DEBUG=1 vpd-info     with a traceback where something fails

Prints to the terminal and writes nothing. Exit codes: 0 all that is required is there, 2 something is missing or
too old.
"""

# What an optional package is for, and how to get it.
_EXTRAS = {
    "torch-cluster": ("a neighbour backend", "make cluster"),
    "triton": ("fast kernels on GPUs", "pip install triton (PyTorch for CUDA brings it along)"),
    "wandb": ("logger=wandb", "pip install wandb"),
    "rosbags": ("importing ROS bags", "pip install 'vpd-lightning[ros]'"),
    "pyarrow": ("importing LeRobot data sets", "pip install 'vpd-lightning[lerobot]'"),
    "hydra-submitit-launcher": ("many runs on a cluster", "pip install 'vpd-lightning[slurm]'"),
    "pytorch-mppi": ("planning with MPPI", "pip install 'vpd-lightning[planning]'"),
    "gymnasium": ("the pushing scene as an environment", "pip install 'vpd-lightning[planning]'"),
    "av": ("importing LeRobot videos", "pip install 'vpd-lightning[lerobot]'"),
}
RELEASED = "released"
"""The folder, below the current one, whose models are listed."""

_NEIGHBOR_BACKENDS = {
    "torch": "torch",
    "scipy": "scipy",
    "numba": "numba",
    "torch_cluster": "torch_cluster",
    "triton": "triton",
}
_GL_PACKAGES = (
    "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 libgl1 (EGL), or libosmesa6 (OSMesa); "
    "scene=mujoco_block renderer=raycast needs neither"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(lambda: _info(list(sys.argv[1:] if argv is None else argv)))


def _info(argv: list[str]) -> int:
    if any(word in ("-h", "--help") for word in argv):
        print(HELP, end="")
        return 0
    unknown = [word for word in argv if word != "--json"]
    if unknown:
        raise ConfigError(f"vpd-info does not know {unknown[0]}.\nIt knows --json and --help.")
    report = collect()
    print(json.dumps(report, indent=1) if "--json" in argv else render(report))
    return 2 if report["problems"] else 0


def collect() -> dict[str, Any]:
    """Return everything the report says, as plain values; nothing optional needs to be installed."""
    packages, problems = _packages()
    return {
        "vpd-lightning": version_of(DISTRIBUTION) or "not installed as a package",
        "git_commit": git_commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "free_disk_gib": round(shutil.disk_usage(".").free / 2**30, 1),
        "packages": packages,
        "devices": devices() if importlib.util.find_spec("torch") else [],
        "gl": _gl_backends(),
        "neighbors": {
            name: importlib.util.find_spec(module) is not None for name, module in _NEIGHBOR_BACKENDS.items()
        },
        "blender": _blender(),
        "optional": {name: version_of(name) for name in _EXTRAS},
        "released": list_releases(Path(RELEASED)),
        "problems": problems,
    }


def render(report: dict[str, Any]) -> str:
    """Return the report as plain lines."""
    lines = [
        f"vpd-lightning  {report['vpd-lightning']}"
        + (f"  commit {report['git_commit']}" if report["git_commit"] else ""),
        f"python         {report['python']} on {report['platform']}",
        f"free disk      {report['free_disk_gib']} GiB here",
        "",
        "packages",
    ]
    for name, entry in report["packages"].items():
        lines.append(f"  {name:26}{entry['installed'] or 'missing':16}needs {entry['needs'] or 'any version'}")
    lines += ["", "devices", *(f"  {device}" for device in report["devices"])]
    lines += ["", "GL backends (vpd-data generate)"]
    lines += [f"  {name:26}{'works' if reason is None else reason}" for name, reason in report["gl"].items()]
    if all(reason is not None for reason in report["gl"].values()):
        lines.append(f"  missing: {_GL_PACKAGES}")
    lines += ["", "neighbour backends"]
    lines += [f"  {name:26}{'available' if there else 'missing'}" for name, there in report["neighbors"].items()]
    lines += ["", "optional"]
    for name, installed in report["optional"].items():
        purpose, command = _EXTRAS[name]
        lines.append(f"  {name:26}{installed or f'missing, for {purpose}: {command}'}")
    lines.append(f"  {'blender':26}{report['blender'] or 'missing, for renderer=blender: make blender'}")
    if report["released"]:
        lines += ["", f"released models (in ./{RELEASED}; vpd-eval ckpt=FOLDER measures one)"]
        lines += [f"  {_released_line(entry)}" for entry in report["released"]]
    lines += ["", *(report["problems"] or ["Everything that is required is there."])]
    return "\n".join(lines)


def _released_line(entry: Mapping[str, Any]) -> str:
    if entry["fault"]:
        return f"{entry['folder']:32} {entry['fault']}"
    score = "" if entry.get(HEADLINE) is None else f"  {metric(HEADLINE).spoken(entry[HEADLINE])}"
    return (
        f"{entry['folder']:32} {entry['system']}, {entry['experiment']}, {entry['num_parameters']:,} parameters, "
        f"{entry['bytes'] / 1e6:.1f} MB{score}"
    )


def _packages() -> tuple[dict[str, dict[str, str | None]], list[str]]:
    """Return the required packages with installed version and floor, and a line for each that does not fit."""
    packages: dict[str, dict[str, str | None]] = {}
    problems = []
    required = requirements()
    if not required:
        problems.append(
            f"{DISTRIBUTION} is not installed as a package, so versions cannot be checked: pip install -e ."
        )
    for requirement in required:
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        installed = version_of(requirement.name)
        packages[requirement.name] = {"installed": installed, "needs": str(requirement.specifier)}
        if installed is None:
            problems.append(f"missing: {requirement.name}. pip install '{requirement}'")
        elif not requirement.specifier.contains(installed, prereleases=True):
            problems.append(f"{requirement.name} {installed} does not fit. pip install '{requirement}'")
    if not (3, 11) <= sys.version_info[:2] <= (3, 13):
        problems.append(f"Python {platform.python_version()} is not supported; use 3.11, 3.12 or 3.13.")
    return packages, problems


def _blender() -> str | None:
    """Return the Python that has Blender, or None."""
    from data_gen.blender.process import find_python

    try:
        return str(find_python())
    except ConfigError:
        return None


def _gl_backends() -> dict[str, str | None]:
    """Return, for each GL backend, None where it renders and the reason where it does not."""
    if importlib.util.find_spec("mujoco") is None:
        return {"egl": "mujoco is missing", "osmesa": "mujoco is missing"}
    try:
        from data_gen.gl_backend import GL_BACKENDS, why_not

        return {name: why_not(name) for name in GL_BACKENDS}
    except (ImportError, RenderingBackendError) as error:
        return {"egl": str(error), "osmesa": str(error)}


if __name__ == "__main__":
    sys.exit(main())
