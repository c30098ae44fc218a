"""``vpd-view``: watch and edit a prediction in the browser."""

import gc
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

    config = configure("view", words)
    if config is not None:
        viewer = start(config)
        try:
            viewer.server.sleep_forever()
        finally:
            viewer.stop()
    return 0


def start(config: Mapping[str, Any]) -> Any:
    """Start the viewer that a configuration of ``vpd-view`` describes, print its address, and return it.

    Raises:
        ConfigError: viser is missing, the port is taken, or a value is out of range.
        VPDError: whatever is wrong with the checkpoint or the data.
    """
    _check(config)
    try:
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"vpd-view needs {error.name}, which is not installed.\npip install 'vpd-lightning[viewer]'"
        ) from error
    from vpd_lightning.viewer.guard import HOST, new_token
    from vpd_lightning.viewer.server import Viewer

    viewer = Viewer(config["port"], new_token(), config["kiosk"])
    try:
        print(f"Open {viewer.url}\n")
        print(f"From another machine: ssh -L {viewer.port}:{HOST}:{viewer.port} THIS_MACHINE, then the same address.")
        print("Ctrl-C ends it.", flush=True)
        gc.disable()  # imports leave no garbage, and looking for it takes a tenth of their time
        try:
            _show(viewer, config)
        finally:
            gc.enable()
    except BaseException:
        viewer.stop()
        raise
    return viewer


def _show(viewer: Any, config: Mapping[str, Any]) -> None:
    from vpd_lightning.release.results_folder import beside_checkpoint
    from vpd_lightning.runs.one_recording import choose_trajectory, data_set, load_particle_simulator
    from vpd_lightning.runs.threads import set_threads
    from vpd_lightning.viewer.opened_scene import open_scene

    # The browser draws on this machine, too. Where PyTorch's threads wait for a core that it holds, all of them wait.
    set_threads(config["num_threads"], num_free=1)
    model = load_particle_simulator(config)
    split, number = config["split"], config["trajectory"]
    viewer.say("Looking for the recording; where its data are missing, it is made ...")
    manifest = data_set(config["data"]["folder"], model.config, only=(split, number))
    path = choose_trajectory(manifest, split, number)
    start_frame = config["start_frame"]
    viewer.say("Looking at two frames of the recording ...")
    title = f"{manifest.scene.replace('_', ' ')}, {split} recording {number}".capitalize().replace("Mujoco", "MuJoCo")
    opened = open_scene(model.simulator, path, start_frame, model.input_views, title, manifest.scene, manifest)
    viewer.show(opened, beside_checkpoint(model.path, "view"), config["num_steps"])
    print(f"{model.name}, {manifest.relative(path)}, frame {start_frame}", flush=True)


def _check(config: Mapping[str, Any]) -> None:
    for name, lowest, highest in (("num_steps", 1, 1000), ("start_frame", 0, None), ("port", 0, 65535)):
        value = config[name]
        if value < lowest or (highest is not None and value > highest):
            allowed = f"{lowest} or more" if highest is None else f"{lowest} to {highest}"
            raise ConfigError(f"{name}={value} is out of range.\nAllowed: {allowed}.")
    kiosk = config["kiosk"]
    if kiosk is not None and not kiosk >= 5:
        raise ConfigError(f"kiosk={kiosk} is out of range.\nAllowed: 5 seconds or more, or null.")


if __name__ == "__main__":
    sys.exit(main())
