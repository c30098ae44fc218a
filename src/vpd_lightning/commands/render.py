"""``vpd-render``: film what a trained simulator predicts, from any camera, and keep its particles."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    from vpd_lightning.commands.hydra_application import configure

    config = configure("render", words)
    if config is not None:
        _render(config)
    return 0


def _render(config: Mapping[str, Any]) -> None:
    import torch

    from vpd_lightning.editing.colored_editor import colored_editor
    from vpd_lightning.editing.edit_files import load_edit, replay
    from vpd_lightning.errors import OutOfMemoryError
    from vpd_lightning.evaluation.prediction import encode_clip, recorded_motion
    from vpd_lightning.files import OutputFolder, choose_folder
    from vpd_lightning.media import render_rollout
    from vpd_lightning.media.nerfstudio_paths import write_camera_path
    from vpd_lightning.media.viewpoints import choose_viewpoints, resize_viewpoints
    from vpd_lightning.release.results_folder import beside_checkpoint
    from vpd_lightning.runs.one_recording import choose_trajectory, data_set, load_particle_simulator
    from vpd_lightning.runs.progress import show_progress
    from vpd_lightning.runs.threads import set_threads

    _check(config)
    set_threads(config["num_threads"])
    operations = load_edit(config["edit"]) if config["edit"] is not None else []
    model = load_particle_simulator(config)
    manifest = data_set(config["data"]["folder"], model.config, only=(config["split"], config["trajectory"]))
    path = choose_trajectory(manifest, config["split"], config["trajectory"])
    start, freeze_step = config["start_frame"], config["freeze_step"]
    clip = render_rollout.read_context(path, start)
    num_frames = (config["num_views"] if freeze_step is not None else None) or config["num_steps"] + 1
    chosen = choose_viewpoints(
        config["camera"], path, start, num_frames, model.input_views, frozen=freeze_step is not None
    )
    viewpoints = resize_viewpoints(chosen, config["height"], config["width"])
    folder = choose_folder(config["out"], beside_checkpoint(model.path, "render"))
    with OutputFolder(folder) as partial:
        if config["save_camera_path"]:  # first: cameras that the format cannot hold are refused before the work
            write_camera_path(partial / "camera_path.json", viewpoints.cameras, config["fps"], viewpoints.is_cycle)
        try:
            with show_progress() as progress:
                scene = encode_clip(model.simulator, clip, model.input_views)
                if operations:
                    viewpoint = clip.cameras.cam_to_world[1, :, :3, 3].mean(0)
                    scene = replay(colored_editor(model.simulator, scene, viewpoint), operations).scene
                motion = recorded_motion(model.simulator, path, start, max(config["num_steps"], freeze_step or 0))
                states = render_rollout.predict(model.simulator, scene, config["num_steps"], freeze_step, motion)
                rendered = render_rollout.render_rollout(model.simulator, list(states.values()), viewpoints, progress)
        except torch.OutOfMemoryError as error:
            raise OutOfMemoryError(
                "The device ran out of memory while rendering.\nLower height and width, or use device=cpu."
            ) from error
        truth = None
        if viewpoints.views is not None and not operations:  # of an edited scene there is no truth
            truth = render_rollout.recorded_frames(path, start, list(states), viewpoints.views)
        kinds = config["save_films"]
        render_rollout.write_videos(partial, viewpoints, rendered, truth, config["fps"], config["save_maps"], kinds)
        if freeze_step is not None:
            render_rollout.write_moment_sheet(partial, viewpoints, rendered, truth, freeze_step, config["save_maps"])
        render_rollout.write_particle_folder(partial, model.simulator, clip, states, config["save_particles"])
        is_film = rendered.rgb.shape[0] > 1
        render_rollout.write_description(
            partial / "render.json",
            {
                "checkpoint": str(model.path),
                "checkpoint_sha256": model.sha256,
                "data": str(manifest.folder),
                "trajectory": manifest.relative(path),
                "start_frame": start,
                "edit": config["edit"],
                "num_steps": max(states),
                "freeze_step": freeze_step,
                "camera": config["camera"],
                "height": viewpoints.cameras.height,
                "width": viewpoints.cameras.width,
                "films": [f"{name}.{kind}" for name in viewpoints.names for kind in kinds] if is_film else [],
                "maps": config["save_maps"],
            },
        )
    count = len(viewpoints.names)
    kind = "film" if is_film else "picture"
    films = f"1 {kind}" if count == 1 else f"{count} {kind}s"
    moment = f"of {max(states)} steps" if freeze_step is None else f"of step {freeze_step}"
    print(f"{films} {moment} from {manifest.relative(path)}, start frame {start}")
    print(folder)


def _check(config: Mapping[str, Any]) -> None:
    from vpd_lightning.media.filmed_maps import MAPS
    from vpd_lightning.media.render_rollout import PARTICLE_FORMATS
    from vpd_lightning.media.video import FILM_FORMATS

    for name, lowest in (("num_steps", 1), ("start_frame", 0)):
        if config[name] < lowest:
            raise ConfigError(f"{name}={config[name]} is out of range.\nAllowed: {lowest} or more.")
    for name in ("height", "width"):
        if config[name] is not None and config[name] < 1:
            raise ConfigError(f"{name}={config[name]} is out of range.\nAllowed: 1 pixel or more, or null.")
    if not 0 < config["fps"] <= 1000:
        raise ConfigError(f"fps={config['fps']} is out of range.\nAllowed: above 0, up to 1000.")
    if config["freeze_step"] is not None and config["freeze_step"] < 0:
        raise ConfigError(
            f"freeze_step={config['freeze_step']} is out of range.\nAllowed: 0 (the last input frame) or more, or null."
        )
    if config["num_views"] is not None:
        if config["num_views"] < 1:
            raise ConfigError(f"num_views={config['num_views']} is out of range.\nAllowed: 1 or more, or null.")
        if config["freeze_step"] is None or config["camera"] != "ring":
            raise ConfigError(
                "num_views is the number of camera positions on a ring around one frozen step.\n"
                "Set camera=ring and freeze_step=STEP, or leave num_views out."
            )
    for name, allowed in (("save_films", FILM_FORMATS), ("save_particles", PARTICLE_FORMATS), ("save_maps", MAPS)):
        unknown = [word for word in config[name] if word not in allowed]
        if unknown or len(set(config[name])) < len(config[name]):
            said = repr(unknown[0]) if unknown else "a word twice"
            raise ConfigError(f"{name} has {said}.\nAllowed: {', '.join(allowed)}, or [] for none.")


if __name__ == "__main__":
    sys.exit(main())
