"""One training, from its checked configuration to its last step."""

import json
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning.pytorch import Callback, LightningDataModule, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import SLURMEnvironment

from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.data.recorded_scene import RECORDINGS, recorded_scene_notes
from vpd_lightning.errors import ConfigError
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.randomness import derive_seed
from vpd_lightning.runs.environment import environment
from vpd_lightning.runs.first_training import FirstTraining, hand_over, train_first
from vpd_lightning.runs.precision import AUTO, chosen_precision
from vpd_lightning.runs.provide_data import provide_data, require_trusted_data
from vpd_lightning.runs.resume import OVERRIDES_FILE, has_own_checkpoint, quote
from vpd_lightning.runs.run_claim import claimed
from vpd_lightning.runs.training_errors import (
    named_disk_errors,
    named_lost_process,
    named_memory_errors,
    named_range_errors,
    plain_interrupt,
)
from vpd_lightning.system import AbstractSystem
from vpd_lightning.training.callbacks.memory_estimate import MemoryEstimate
from vpd_lightning.training.callbacks.time_budget import TimeBudget
from vpd_lightning.training.checkpoint_files import LAST
from vpd_lightning.training.checkpoint_io import AtomicCheckpointIO
from vpd_lightning.training.checkpoints import FOLDER as CHECKPOINTS
from vpd_lightning.training.checkpoints import find_resume
from vpd_lightning.training.light import fit_light_of
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import AbstractOptimization

CONFIG_FILE = "config.yaml"
ENVIRONMENT_FILE = "environment.json"

log = logging.getLogger(__name__)


def train_in(folder: Path, config: dict[str, Any], overrides: Sequence[str], *, is_rank_zero: bool) -> None:
    """Train in the run folder; a run that fails before its first step leaves no folder behind.

    Raises:
        VPDError: whatever is wrong with configuration, data, checkpoint or memory.
    """
    is_new = is_rank_zero and not config["resume"]
    with claimed(folder, is_new=is_new) if is_rank_zero else nullcontext():
        try:
            with named_memory_errors(), named_disk_errors(folder), _libraries_in_log():
                _set_numerics(config, folder, is_rank_zero)
                if is_new and config["pretraining"]:  # the first training may end before fit() describes the second
                    _describe(folder, config, overrides, is_resumed=False)
                first = train_first(folder, config, overrides, is_rank_zero, fit)
                # A run that was stopped in its first training has no checkpoint of its own yet.
                checkpoint = find_resume(folder) if config["resume"] and has_own_checkpoint(folder) else None
                fit(folder, config, overrides, is_rank_zero, checkpoint, first)
        except BaseException:
            if is_new and not any(folder.glob(f"**/{CHECKPOINTS}/*.ckpt")):
                _forget(folder, overrides)
            raise
        if config["evaluate"] and is_rank_zero:
            evaluate_run(folder, config)


def evaluate_run(folder: Path, config: Mapping[str, Any]) -> None:
    """Evaluate the last checkpoint as ``vpd-eval`` does: beside it, where a run that went on has earlier ones."""
    from vpd_lightning.runs.evaluation_run import run_evaluation

    words = {"ckpt": folder / CHECKPOINTS / LAST, "num_threads": config["num_threads"], "force": config["force"]}
    settings = compose("eval", [f"{key}={quote(str(value))}" for key, value in words.items() if value is not None])
    run_evaluation(settings)


def fit(
    folder: Path,
    config: dict[str, Any],
    overrides: Sequence[str],
    is_rank_zero: bool,
    checkpoint: Path | None,
    first: FirstTraining | None,
) -> None:
    """Build everything and train: anew, from a checkpoint, or from the weights of a first training."""
    provide_data(config, overrides)
    require_trusted_data(config)
    if is_rank_zero and config["scene"]["name"] == RECORDINGS:
        print(*recorded_scene_notes(config["data"]["folder"], config["scene"]), sep="\n", flush=True)
    datamodule = build(config["data"], LightningDataModule, "data")
    datamodule.setup("fit")
    system = _build_system(config)
    _fit_background(system, datamodule)
    module = VPDModule(
        simulator=system,
        losses=build_list(config["loss"], AbstractLoss, "loss"),
        optimization=build(config["optimizer"], AbstractOptimization, "optimizer"),
        config=config,
    )
    callbacks = build_list(config["callbacks"], Callback, "callbacks")
    if first is not None:
        module.remember(hand_over(first, system, datamodule, callbacks, folder, config))
    elif checkpoint is None and config["light_fit"]["num_pairs"]:
        _fit_light(system, datamodule, callbacks, config)
    trainer = build(
        config["trainer"],
        Trainer,
        "trainer",
        logger=build_list(config["logger"], Logger, "logger") or False,
        callbacks=[MemoryEstimate(force=config["force"]), *callbacks],
        plugins=[AtomicCheckpointIO(), *_cluster()],
    )
    if is_rank_zero:
        _describe(folder, config, overrides, checkpoint is not None)
        print(f"run folder: {folder}", flush=True)
    with plain_interrupt(), named_range_errors(trainer), named_lost_process(trainer):
        trainer.fit(module, datamodule=datamodule, ckpt_path=checkpoint, weights_only=True)


def _cluster() -> list[SLURMEnvironment]:
    """Return how Lightning finds the processes of a SLURM job; its own checkpoints before a requeue are not ours."""
    if not SLURMEnvironment.detect():
        return []
    try:
        return [SLURMEnvironment(auto_requeue=False)]
    except RuntimeError as error:
        raise ConfigError(f"the SLURM job does not fit a training.\n{error}") from error


def _build_system(config: dict[str, Any]) -> AbstractSystem:
    """Build the system with initial weights that depend on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(config["seed"], "weights"))
        return build_simulator(config)


def _fit_background(system: AbstractSystem, datamodule: Any) -> None:
    background = getattr(getattr(system, "encoder", None), "background", None)
    if background is not None and background.needs_fit:
        background.fit(*datamodule.median_background())


def _fit_light(
    system: AbstractSystem, datamodule: Any, callbacks: Sequence[Callback], config: Mapping[str, Any]
) -> None:
    """Fit the lights of a new training; the time counts as that of its updates does.

    Raises:
        ConfigError: it took all the time there is.
    """
    clocks = [callback for callback in callbacks if isinstance(callback, TimeBudget)]
    began = [clock.now() for clock in clocks]
    fit_light_of(system, datamodule.trajectories, datamodule.input_views, config["seed"], **config["light_fit"])
    for clock, start in zip(clocks, began, strict=True):
        clock.seconds += clock.now() - start
        if clock.seconds_allowed is not None and clock.seconds >= clock.seconds_allowed:
            raise ConfigError(
                f"fitting the light took {clock.seconds:.0f} s, all of callbacks.time_budget.minutes={clock.minutes:g}."
                "\nAllow more, lower light_fit.num_pairs and num_updates, or set light_fit.num_pairs=0."
            )


def _set_numerics(config: dict[str, Any], folder: Path, is_rank_zero: bool) -> None:
    """Set threads and precisions explicitly, and write down what was set."""
    if config["trainer"].get("precision") == AUTO:
        chosen, reason = chosen_precision(config["trainer"], folder / CONFIG_FILE if config["resume"] else None)
        config["trainer"]["precision"] = chosen  # from here on it is what was asked for, in the run's own files, too
        if is_rank_zero:
            print(f"precision: {chosen} ({reason})", flush=True)
    if config["num_threads"] is not None:
        torch.set_num_threads(config["num_threads"])
    precision = config["float32_matmul_precision"]
    torch.set_float32_matmul_precision(precision)
    torch.backends.cudnn.allow_tf32 = precision != "highest"
    log.info(
        "float32 products: %s (TF32 %s); deterministic: %s; precision: %s; threads: %d",
        precision,
        "off" if precision == "highest" else "on",
        config["deterministic"],
        config["trainer"].get("precision"),
        torch.get_num_threads(),
    )


def _describe(folder: Path, config: dict[str, Any], overrides: Sequence[str], is_resumed: bool) -> None:
    """Write down what the run was asked to do and where it runs; a resumed run keeps its first settings beside."""
    stamp = f".resumed-{len(list(folder.glob('config*.yaml')))}" if is_resumed else ""
    kept = [word for word in overrides if not word.startswith(("resume=", "run.folder="))]
    (folder / f"config{stamp}.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    (folder / f"environment{stamp}.json").write_text(json.dumps(environment(), indent=1) + "\n", encoding="utf-8")
    (folder / OVERRIDES_FILE).write_text(yaml.safe_dump(kept), encoding="utf-8")


def close_log(folder: Path) -> None:
    """Let go of the run's log file, which Hydra opened: a sweep opens one per run."""
    root = logging.getLogger()
    for handler in list(root.handlers):
        if isinstance(handler, logging.FileHandler) and Path(handler.baseFilename).parent == folder.absolute():
            root.removeHandler(handler)
            handler.close()


def _forget(folder: Path, overrides: Sequence[str]) -> None:
    """Remove the folder of a run that never made a step, and what was made to hold it."""
    close_log(folder)
    shutil.rmtree(folder, ignore_errors=True)
    if not any(word.startswith("run.folder=") for word in overrides):  # else the place is the user's own
        with suppress(OSError):  # other runs are there
            folder.parent.rmdir()
            folder.parent.parent.rmdir()


@contextmanager
def _libraries_in_log() -> Iterator[None]:
    """Send what Lightning says, and warnings, to the run's log instead of the terminal."""
    loggers = [logging.getLogger(name) for name in ("lightning", "lightning.pytorch", "lightning.fabric")]
    before = [(list(logger.handlers), logger.propagate) for logger in loggers]
    for logger in loggers:
        logger.handlers, logger.propagate = [], True
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        for logger, (handlers, propagate) in zip(loggers, before, strict=True):
            logger.handlers, logger.propagate = handlers, propagate
