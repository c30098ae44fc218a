"""What a result depends on beside the configuration: versions, devices, the state of the source."""

import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

DISTRIBUTION = "vpd-lightning"


def environment() -> dict[str, Any]:
    """Return versions, devices and the commit of the source, as plain values."""
    import torch

    return {
        "versions": {"python": platform.python_version(), **installed_versions()},
        "platform": platform.platform(),
        "devices": devices(),
        "cpu_threads": torch.get_num_threads(),
        "float32_matmul_precision": torch.get_float32_matmul_precision(),
        "cudnn_allow_tf32": bool(torch.backends.cudnn.allow_tf32),
        "git_commit": git_commit(),
        "command": sys.argv,
    }


def requirements() -> list[Requirement]:
    """Return what this package requires, optional parts included; empty in a checkout that was never installed."""
    try:
        return [Requirement(line) for line in requires(DISTRIBUTION) or []]
    except PackageNotFoundError:
        return []


def version_of(name: str) -> str | None:
    """Return the installed version of a distribution, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def installed_versions() -> dict[str, str]:
    """Return the versions of this package and of what it requires, as far as installed."""
    names = [DISTRIBUTION, "torch", "lightning", *(requirement.name for requirement in requirements())]
    found = {name: version_of(name) for name in dict.fromkeys(names)}
    return {name: number for name, number in found.items() if number is not None}


def devices() -> list[str]:
    """Return the names of the CPU and of every accelerator that PyTorch sees."""
    import torch

    found = [f"cpu: {platform.processor() or platform.machine()}, {torch.get_num_threads()} threads in use"]
    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            properties = torch.cuda.get_device_properties(index)
            found.append(f"cuda:{index}: {properties.name}, {properties.total_memory / 2**30:.0f} GiB")
    return found


def git_commit() -> str | None:
    """Return the commit of the checkout that this code runs from, marked where files differ from it; else None."""
    folder = Path(__file__).resolve().parent
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit} (with changes)" if changed else commit


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()
