r"""Training on a rented GPU machine, in pieces of a few minutes.

    # where the data and the whole project are
    python -m benchmarks.rented_gpu pack --out pack.npz --updates 3000,20000 --limit-mib 12 \
        experiment=mujoco_block model=vpd_staged budget=hour data.folder=DATA

    # on the machine with the GPU: needs torch and what the core imports (numpy, scipy, jaxtyping); PYTHONPATH=.:src
    python -m benchmarks.rented_gpu train --pack pack.npz --out OUT --minutes 9 [--resume OUT | --weights STATE]

    # back at home: a run folder for vpd-eval, vpd-view, vpd-export and pretraining.ckpt
    python -m benchmarks.rented_gpu run --pack pack.npz --state OUT --folder RUN

Words without dashes are those of vpd-train. ``pack`` takes as many training trajectories as fit. A model that is
trained in two trainings needs two numbers of ``--updates``. ``train`` stops after its minutes, leaves at most seven
files of 15 MiB and ``curve.json`` in ``--out``, and goes on from there with ``--resume``, there or elsewhere. With
``--weights`` the last training begins with the weights of another state, which may be of another pack: other lengths
of clips, another data set, another loss.
"""

import argparse
import sys
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any


def main(arguments: list[str] | None = None) -> int:
    """Run one of the commands; 1 where something is wrong with what it was given."""
    from vpd_lightning.errors import VPDError

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    pack = commands.add_parser("pack", help="recordings and settings into one file")
    pack.add_argument("--out", type=Path, required=True)
    pack.add_argument("--updates", type=_counts, required=True, help="of each training, for example 3000,20000")
    pack.add_argument("--limit-mib", type=float, default=12.0)
    pack.add_argument("overrides", nargs="*", help="as for vpd-train")
    pack.set_defaults(call=_pack)
    train = commands.add_parser("train", help="train for some minutes")
    train.add_argument("--pack", type=Path, required=True)
    train.add_argument("--out", type=Path, required=True)
    start = train.add_mutually_exclusive_group()
    start.add_argument("--resume", type=Path, help="folder with the state to go on from")
    start.add_argument("--weights", type=Path, help="folder with a state whose weights the last training begins with")
    train.add_argument("--minutes", type=float, default=9.0, help="until it stops")
    train.add_argument("--minutes-in-all", type=float, help="of all phases, earlier calls counted in; not --updates")
    train.add_argument("--seed", type=int, help="another one than the pack's; kept on resume")
    train.add_argument("--clips", type=int, help="of an update of the last training")
    train.add_argument("--precision", choices=["bf16", "tf32", "float32"], help="another one than the pack's")
    train.add_argument("--save-minutes", type=float, default=2.0)
    train.add_argument("--profile", type=int, help="after so many updates, print what three more spend their time on")
    train.add_argument("--device", default="cuda")
    train.add_argument("--workers", type=int, default=8, help="processes that draw clips")
    train.set_defaults(call=_train)
    run = commands.add_parser("run", help="a run folder from a state")
    run.add_argument("--pack", type=Path, required=True)
    run.add_argument("--state", type=Path, required=True)
    run.add_argument("--folder", type=Path, required=True)
    run.set_defaults(call=_run)
    options = parser.parse_args(arguments)
    try:
        options.call(options)
    except VPDError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _counts(text: str) -> list[int]:
    return [int(word) for word in text.split(",")]


def _pack(options: argparse.Namespace) -> None:
    from benchmarks.rented_gpu.packing import write_pack
    from vpd_lightning.config import build, compose
    from vpd_lightning.config.pretraining import pretraining_config
    from vpd_lightning.data.background import median_images
    from vpd_lightning.data.datamodule import VideoDataModule
    from vpd_lightning.data.frames import TrajectoryFrames
    from vpd_lightning.data.manifest import load_manifest
    from vpd_lightning.errors import ConfigError

    config = compose("train", ["run.folder=unused", *options.overrides])
    first = pretraining_config(config)
    configs = [config] if first is None else [first, config]
    if len(options.updates) != len(configs) or min(options.updates) < 1:
        raise ConfigError(f"--updates needs {len(configs)} numbers above 0, one for each training of this model.")
    manifest = load_manifest(config["data"]["folder"])
    files = manifest.split("train")[: config["data"]["num_trajectories"]]
    trajectories = [TrajectoryFrames(path, use_cache=False) for path in files]
    targets = config["data"]["target_views"]
    targets = list(range(trajectories[0].num_views)) if targets is None else targets
    phases = [_phase(one, count, targets) for one, count in zip(configs, options.updates, strict=True)]
    first_share = config["pretraining"]["share"] if first else 0.0
    for phase, share in zip(phases[::-1], (1.0 - first_share, first_share), strict=False):
        phase["share"] = share
    views = sorted({*config["data"]["input_views"], *targets})
    moving_rays = None
    if config["data"]["moving_ray_fraction"]:
        moving_rays = build(config["data"], VideoDataModule, "data").clip_dataset(max_steps=1).moving_rays
    fitted, size = write_pack(
        options.out,
        {"phases": phases, "config": config},
        trajectories,
        manifest.checksums(files),
        views=views,
        base=median_images(trajectories, views),
        input_views=config["data"]["input_views"],
        limit_bytes=int(options.limit_mib * 2**20),
        moving_rays=moving_rays,
        target_views=targets,
    )
    print(f"{options.out}: {fitted} of {len(files)} training trajectories, {size / 2**20:.2f} MiB")


def _phase(config: dict[str, Any], updates: int, target_views: list[int]) -> dict[str, Any]:
    """Return what one training needs of its configuration.

    Raises:
        ConfigError: it needs something that the loop does not offer.
    """
    from benchmarks.rented_gpu.training import CLIPS, STAGES
    from vpd_lightning.errors import ConfigError

    if not all(config.get(name) for name in STAGES):
        raise ConfigError("Only systems of encoder, dynamics and renderer can be trained so.\nUse vpd-train.")
    if config["encoder"].get("background"):
        raise ConfigError(
            "An encoder with a background needs the whole training split.\n"
            "Set encoder.background=null, or use vpd-train."
        )
    data = {name: config["data"][name] for name in (*CLIPS, "moving_ray_fraction")} | {"target_views": target_views}
    sections = {name: config[name] for name in (*STAGES, "model", "loss", "optimizer", "seed")}
    trainer = {name: config["trainer"].get(name) for name in ("precision", "gradient_clip_val")}
    averaging = (config.get("callbacks") or {}).get("weight_averaging")
    averaging = averaging and {name: averaging[name] for name in ("decay", "warmup")}
    return {**sections, "data": data, "trainer": trainer, "averaging": averaging, "updates": updates}


def _train(options: argparse.Namespace) -> None:
    import torch

    from benchmarks.rented_gpu.packing import read_pack
    from benchmarks.rented_gpu.progress import Progress, beginning_with, read_progress
    from benchmarks.rented_gpu.training import Training

    deadline = time.perf_counter() + 60 * options.minutes
    settings, trajectories = read_pack(options.pack)
    print(f"{len(trajectories)} trajectories unpacked", flush=True)
    if options.resume:
        progress = read_progress(options.resume)
    elif options.weights:
        progress = beginning_with(read_progress(options.weights), len(settings["phases"]) - 1, options.seed)
    else:
        progress = Progress(seed=options.seed)
    in_all = None if options.minutes_in_all is None else 60 * options.minutes_in_all
    training = Training(
        _changed(settings["phases"], progress.seed, options.clips),
        trajectories,
        torch.device(options.device),
        options.workers,
        progress,
        seconds_in_all=in_all,
        precision=options.precision,
    )
    if options.profile is not None:
        print(training.profiled(options.profile))
        return
    before = (progress.seconds, len(progress.curve))
    training.run(deadline, options.out, 60 * options.save_minutes)
    seconds, points = progress.seconds - before[0], progress.curve[before[1] :]
    for point in points[:: max(1, len(points) // 20)]:
        print("  ".join(f"{name} {value:.5g}" for name, value in point.items()))
    _print_paces(points)
    where = "done" if training.is_done else f"phase {progress.phase}, update {progress.step}"
    each = seconds / max(1, training.num_taken)
    print(f"{where}; {seconds:.1f} s of updates now ({each:.3f} s each), {progress.seconds:.1f} s in all")
    if training.device.type == "cuda":
        print(f"{torch.cuda.get_device_name()}: {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB at most")


def _print_paces(points: list[dict[str, float]]) -> None:
    """Print seconds an update of each phase and rollout length, the first of each left out."""
    found: dict[tuple[int, int], list[float]] = {}
    for before, point in pairwise(points):
        place = (int(point["phase"]), int(point["num_steps"]))
        if place == (int(before["phase"]), int(before["num_steps"])):
            found.setdefault(place, []).append(
                (point["seconds"] - before["seconds"]) / (point["step"] - before["step"])
            )
    for (phase, num_steps), paces in found.items():
        print(f"phase {phase}, {num_steps} predicted steps: {median(paces):.3f} s an update")


def _changed(phases: list[dict[str, Any]], seed: int | None, clips: int | None) -> list[dict[str, Any]]:
    """Return the phases with another seed (of weights and clips), the last one with other clips an update."""
    changed = [{**phase, "data": dict(phase["data"])} for phase in phases]
    if seed is not None:
        for phase in changed:
            phase["seed"] = phase["data"]["seed"] = seed
    if clips is not None:
        changed[-1]["data"]["batch_size"] = clips
    return changed


def _run(options: argparse.Namespace) -> None:
    from benchmarks.rented_gpu.packing import read_settings
    from benchmarks.rented_gpu.progress import read_progress
    from benchmarks.rented_gpu.training import build_system
    from vpd_lightning.data.trained_on import TRAINED_ON
    from vpd_lightning.errors import CheckpointError
    from vpd_lightning.training.checkpoint_files import LAST, write_checkpoint

    settings, progress = read_settings(options.pack), read_progress(options.state)
    last = build_system(settings["phases"][-1])
    missing = sorted(set(last.state_dict()) - set(progress.weights))
    if missing:
        raise CheckpointError(
            f"{options.state} stands in phase {progress.phase} and has no {missing[0]} yet.\n"
            "Train until the last phase."
        )
    path = options.folder / "checkpoints" / LAST
    weights = {**progress.weights, **progress.average}
    config = settings["config"]
    if progress.seed is not None:
        config = {**config, "seed": progress.seed, "data": {**config["data"], "seed": progress.seed}}
    content = {
        "state_dict": {f"simulator.{name}": weights[name] for name in last.state_dict()},
        "hyper_parameters": config,
        "global_step": progress.step,
        TRAINED_ON: settings["checksums"],
    }
    write_checkpoint(content, path)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
