"""The demo's last input frame, rendered again by a model: from its own cameras, and from cameras beside them.

Usage: ``python -m docs.results.studies.shifted_camera MODEL --data datasets/mujoco_block_demo --out OUT.json``.

A camera that stands where an input camera stood shows how well particles hold a picture; one beside it, whether the
picture holds together when one looks from elsewhere. The true pictures of the shifted cameras are drawn as the data
were: by MuJoCo's ray casting, from the recorded pose. Each camera is shifted by ``--shift`` metres along its own
x axis in both directions, and looks in the same direction.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from data_gen.cameras import camera_intrinsics, camera_poses
from data_gen.mujoco_block.raycast import RaycastRenderer
from data_gen.mujoco_block.scene import scene_xml
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.settings import load_settings
from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.images import as_float
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.evaluation.statistics import summarize
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import load_model
from vpd_lightning.metrics.psnr import psnr
from vpd_lightning.metrics.ssim import ssim_of_images
from vpd_lightning.metrics.true_images import TrueImages
from vpd_lightning.types import Cameras


def shifted(poses: NDArray[np.float64], shift: float) -> NDArray[np.float64]:
    """Return camera poses (``camera 4 4``, camera to world) moved by ``shift`` metres along their own x axes."""
    moved = poses.copy()
    moved[:, :3, 3] += shift * poses[:, :3, 0]
    return moved


class TruePictures:
    """Draws the demo's block at a recorded pose, from any cameras."""

    def __init__(self, settings: MujocoBlockSettings, cam_to_world: NDArray[np.float64]) -> None:
        import mujoco

        self.settings, self.poses, self.intrinsics = settings, cam_to_world, camera_intrinsics(settings.camera)
        self.model = mujoco.MjModel.from_xml_string(scene_xml(settings))
        self.data = mujoco.MjData(self.model)
        self.renderer = RaycastRenderer(settings, self.model, self.intrinsics, cam_to_world)

    def draw(self, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the pictures (``camera height width 3``) of a block at a position (m) and quaternion (w x y z)."""
        import mujoco

        self.data.qpos[:] = np.concatenate([position, quaternion])
        mujoco.mj_forward(self.model, self.data)
        shape = (len(self.poses), self.settings.camera.height, self.settings.camera.width)
        rgb = np.zeros((*shape, 3), np.uint8)
        self.renderer.render(self.data, rgb, np.zeros(shape, np.float32), np.zeros(shape, np.uint8))
        return rgb

    @property
    def cameras(self) -> Cameras:
        camera = self.settings.camera
        intrinsics, poses = (torch.from_numpy(part).float() for part in (self.intrinsics, self.poses))
        return Cameras(intrinsics, poses, camera.height, camera.width)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write both figures of a model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--shift", type=float, default=0.05)
    parser.add_argument("--start", type=int, default=2)
    options = parser.parse_args(arguments)
    settings = load_settings(MujocoBlockSettings, "mujoco_block", "demo", {})
    poses = camera_poses(settings.camera)
    places = {
        "own": TruePictures(settings, poses),
        "left": TruePictures(settings, shifted(poses, -options.shift)),
        "right": TruePictures(settings, shifted(poses, options.shift)),
    }
    model = load_model(options.model)
    paths = load_manifest(options.data).split(options.split)
    scores: dict[str, list[NDArray[np.float64]]] = {
        f"{name}/{score}": [] for name in places for score in ("psnr", "ssim")
    }
    for number, path in enumerate(paths):
        clip = read_clip(path, number, options.start, num_steps=1)
        assert clip.state is not None, "the demo's recordings have ground truth"
        current = encode_clip(model.simulator, clip, model.input_views).current
        frame = clip.current_frame
        for name, place in places.items():
            truth = place.draw(clip.state.positions[frame, 0], clip.state.quaternions[frame, 0])
            if name == "own" and (truth != clip.rgb[-1].numpy()).any():
                raise ValueError(f"{path} was not made by the demo's preset: its pictures cannot be drawn again.")
            found = model.simulator.render([current], place.cameras).float()
            expected = as_float(torch.from_numpy(truth))[None]
            scores[f"{name}/psnr"].append(psnr(found, expected)[0].double().numpy())
            scores[f"{name}/ssim"].append(ssim_of_images(found, TrueImages(expected))[0].double().numpy())
    trajectory = np.arange(len(paths))

    def summed(*names: str) -> dict[str, object]:
        values = np.concatenate([np.stack(scores[name]) for name in names], axis=1)[..., None]
        return {key: summarize(values, trajectory, 1000)[key] for key in ("mean", "ci95", "count")}

    content = {
        "model": options.model,
        "split": options.split,
        "shift": options.shift,
        "own": {score: summed(f"own/{score}") for score in ("psnr", "ssim")},
        "shifted": {score: summed(f"left/{score}", f"right/{score}") for score in ("psnr", "ssim")},
    }
    with AtomicPath(options.out) as part:
        part.write_text(json.dumps(content, indent=1) + "\n")
    for name in ("own", "shifted"):
        means = content[name]
        print(f"{name:8} PSNR {means['psnr']['mean']:.2f} dB  SSIM {means['ssim']['mean']:.3f}")  # type: ignore[index]
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
