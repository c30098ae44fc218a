"""``vpd-train``: compose, make the run folder, build everything, train."""

import logging
import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vpd_lightning.commands.hydra_application import Arguments, answer, parse_arguments, run_composed, run_hydra
from vpd_lightning.commands.report_errors import format_error, run_command
from vpd_lightning.errors import ConfigError, VPDError

SECTIONS = (
    "model", "data", "encoder", "dynamics", "renderer", "loss", "optimizer", "trainer", "callbacks", "logger"
)  # fmt: skip
# Sections refer to the run folder, which has no name yet when they are checked.
_NOT_CHOSEN = "not-chosen-yet"

log = logging.getLogger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(lambda: _train(list(sys.argv[1:] if argv is None else argv)))


def _train(argv: list[str]) -> int:
    arguments = parse_arguments(argv)
    if arguments.is_question:
        answer("train", argv)
        return 0
    from vpd_lightning.runs.sweeps import is_named_sweep

    if not is_named_sweep(arguments.overrides):
        return _train_as_told(arguments)
    if not arguments.is_multirun:
        raise ConfigError("sweep=NAME is for many runs.\nAdd -m: vpd-train -m sweep=NAME ...")
    return _train_sweep(arguments)


def _train_sweep(arguments: Arguments) -> int:
    """All jobs of a named sweep, as far as they are not done."""
    from vpd_lightning.runs.sweeps import run_sweep, sweep_jobs

    jobs = sweep_jobs(arguments.overrides, arguments.config_dir)
    for job in jobs:
        _refuse_several_devices(job.config["trainer"])
        _check_sections(job.config)
    flags = [flag for flag in arguments.flags if flag not in ("-m", "--multirun")]

    def train(words: list[str]) -> None:
        _train_as_told(replace(arguments, overrides=words, flags=flags, is_multirun=False))

    return run_sweep(jobs, train, _show)


def _train_as_told(arguments: Arguments) -> int:
    """One run, or with -m one for each combination of the values that are listed."""
    from vpd_lightning.config import compose_with_folder, expand_sweep
    from vpd_lightning.runs.resume import resumed_overrides, wants_auto

    overrides = resumed_overrides(arguments.overrides, arguments.config_dir)
    jobs = expand_sweep("train", overrides, arguments.config_dir) if arguments.is_multirun else [overrides]
    composed = [compose_with_folder(words, arguments.config_dir, _NOT_CHOSEN) for words in jobs]
    configs = [config for config, _, _ in composed]
    _check_places(configs, overrides, arguments)
    for _, placed, _ in composed:
        _check_sections(placed)
    if wants_auto(arguments.overrides):
        _make_room(configs[0])

    failures: list[Exception] = []
    starter = os.getpid()

    def job(config: Any) -> None:
        """One run; errors are kept, so that Hydra prints nothing of its own and a sweep goes on."""
        try:
            _run_job(config)
        except Exception as error:
            if os.getpid() != starter:  # a launcher took the job elsewhere and brings its error back
                raise
            failures.append(error)
            if arguments.is_multirun:
                _show(error)

    if arguments.is_multirun:
        run_hydra("train", [*arguments.flags, *overrides], job)
    else:
        run_composed("train", [*arguments.flags, *overrides], composed[0][2], job)
    if not failures:
        return 0
    if arguments.is_multirun:
        print(f"{len(failures)} of {len(jobs)} runs failed.", file=sys.stderr)
        return getattr(failures[0], "exit_code", 1)
    raise failures[0]


def _show(error: Exception) -> None:
    """Print the error of one run of a sweep: in short where it is a named one, else with its traceback."""
    if isinstance(error, VPDError):
        print(format_error(error), file=sys.stderr)
    else:
        traceback.print_exception(error)


def _check_sections(config: dict[str, Any]) -> None:
    """Refuse, before a folder is made, classes that may not be built, arguments they do not take, unequal widths."""
    from vpd_lightning.config import check_targets, check_widths, pretraining_config

    for part in (config, pretraining_config(config)):
        if part is None:
            continue
        for section in SECTIONS:
            check_targets(part[section], section)
        check_widths(part)


def _check_places(configs: Sequence[dict[str, Any]], overrides: Sequence[str], arguments: Arguments) -> None:
    """Refuse run folders that exist, and runs that would share one."""
    from vpd_lightning.runs.resume import wants_auto

    for config in configs:
        _check_folder(config, may_set_aside=wants_auto(arguments.overrides))
    if arguments.is_multirun:
        launcher = next((word for word in overrides if word.startswith("hydra/launcher=")), "")
        if "submitit" not in launcher:
            for config in configs:
                _refuse_several_devices(config["trainer"])
        if any(config["run"]["folder"] for config in configs):
            raise ConfigError("run.folder names one folder, but a sweep makes many.\nUse run.root=FOLDER.")
    elif _world_size() > 1 and not configs[0]["run"]["folder"]:
        raise ConfigError(
            "several processes were started, and each would choose a run folder of its own.\n"
            "Set one folder for all of them: run.folder=FOLDER. (vpd-train starts its own processes with trainer=ddp.)"
        )


def _check_folder(config: dict[str, Any], *, may_set_aside: bool) -> None:
    """Refuse a run folder that holds something, but for a start without a checkpoint that ``resume=auto`` may move."""
    from vpd_lightning.runs.resume import has_checkpoint
    from vpd_lightning.runs.run_claim import foreign_files, is_claimed

    folder = config["run"]["folder"]
    if not folder or config["resume"] or not _is_rank_zero():
        return
    path = Path(folder).expanduser()
    if path.is_file():
        raise ConfigError(f"run.folder={folder} is a file.\nName a folder, or remove run.folder.")
    if not _holds_something(path):
        return
    exists = f"run.folder={folder} exists already, and nothing is overwritten.\n"
    other = "name another folder; or remove run.folder."
    if has_checkpoint(path):
        raise ConfigError(f"{exists}Go on with it: resume={folder}; or {other}")
    if is_claimed(path):
        raise ConfigError(
            f"a run that is still going has taken run.folder={folder}; it has saved no checkpoint yet.\n"
            f"Wait for it or stop it; or {other}"
        )
    if foreign := foreign_files(path):
        shown = ", ".join(foreign[:3]) + (", ..." if len(foreign) > 3 else "")
        raise ConfigError(
            f"{exists}It holds no checkpoint to go on from, but what no training starts with: {shown}.\n"
            f"{other.capitalize()}"
        )
    if not may_set_aside:
        raise ConfigError(
            f"{exists}It holds no checkpoint to go on from: a run ended there before it saved one.\n"
            f"Start anew in it with resume=auto (what is there moves to {folder}.aborted-N); or delete it; or {other}"
        )


def _make_room(config: dict[str, Any]) -> None:
    """Move a start without a checkpoint out of the way of the next one; ``_check_folder`` has looked at it."""
    from vpd_lightning.runs.run_claim import set_aside

    folder = config["run"]["folder"]
    if config["resume"] or not _is_rank_zero() or not _holds_something(Path(folder).expanduser()):
        return
    target = set_aside(Path(folder).expanduser())
    print(f"a run ended in {folder} before it saved a checkpoint; what it left is now in {target}", flush=True)


def _holds_something(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _refuse_several_devices(trainer: dict[str, Any]) -> None:
    """Each process of a multi-device run would start the whole sweep again."""
    devices = trainer.get("devices")
    count = len(devices) if isinstance(devices, list) else devices
    if count in ("auto", -1, "-1") and trainer.get("accelerator") != "cpu":
        import torch

        count = max(torch.cuda.device_count(), 1)
    many = trainer.get("num_nodes", 1) > 1 or (str(count).isdigit() and int(str(count)) > 1)
    if many:
        raise ConfigError(
            f"a sweep over runs with several devices (trainer.devices={devices}) would start itself once per device.\n"
            "Set trainer.devices=1, or send the runs to a cluster: hydra/launcher=submitit_slurm."
        )


def _run_job(config: Any) -> None:
    from hydra.core.hydra_config import HydraConfig

    from vpd_lightning.config import plain
    from vpd_lightning.config.run_folders import ENVIRONMENT
    from vpd_lightning.runs.training_run import close_log, train_in

    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    config.run.folder = str(folder)
    before = os.environ.get(ENVIRONMENT)
    os.environ[ENVIRONMENT] = str(folder)  # processes that Lightning starts inherit it
    try:
        train_in(folder, plain(config), [str(word) for word in hydra.overrides.task], is_rank_zero=_is_rank_zero())
    finally:
        close_log(folder)
        if before is None:
            del os.environ[ENVIRONMENT]


def _world_size() -> int:
    """Processes that something else started (torchrun, srun); those that Lightning starts know their folder."""
    from vpd_lightning.config.run_folders import ENVIRONMENT

    if os.environ.get(ENVIRONMENT):
        return 1
    is_interactive = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")  # as Lightning sees it
    tasks = "1" if is_interactive else os.environ.get("SLURM_NTASKS", "1")
    return int(os.environ.get("WORLD_SIZE", tasks))


def _is_rank_zero() -> bool:
    return all(os.environ.get(name, "0") == "0" for name in ("RANK", "LOCAL_RANK", "NODE_RANK", "SLURM_PROCID"))


if __name__ == "__main__":
    sys.exit(main())
