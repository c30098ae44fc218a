"""What the viewer writes: particles, films, camera paths, edits; all of it in one folder, nothing written over."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.editing.edit_files import save_edit
from vpd_lightning.editing.operations import Operation
from vpd_lightning.errors import EditError
from vpd_lightning.media.nerfstudio_paths import write_camera_path
from vpd_lightning.media.particle_files import write_glb, write_particles
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.ply import write_ply
from vpd_lightning.media.video import FILM_FORMATS, write_video
from vpd_lightning.types import Cameras, Particles

PARTICLE_FORMATS = ("ply", "glb", "npz")

__all__ = ["FILM_FORMATS", "PARTICLE_FORMATS", "ExportFolder", "as_pose"]


class ExportFolder:
    """Names files ``<kind>_<number>.<suffix>`` in a folder that is made with the first of them."""

    def __init__(self, folder: Path):
        self.folder = folder

    def free(self, kind: str, suffix: str) -> Path:
        """Return the first name that is not taken."""
        self.folder.mkdir(parents=True, exist_ok=True)
        number = 1
        while (path := self.folder / f"{kind}_{number:03d}.{suffix}").exists():
            number += 1
        return path

    def particles(self, state: Particles, colors: UInt8[NDArray, "particle 3"], suffix: str) -> Path:
        """Write the particles that are there, in one of ``PARTICLE_FORMATS``.

        Raises:
            EditError: there are none.
        """
        there = state.mask[0].cpu().numpy()
        if not there.any():
            raise EditError("There are no particles to write.")
        positions = state.positions[0].float().cpu().numpy()[there]
        path = self.free("particles", suffix)
        if suffix == "ply":
            write_ply(path, positions, colors[there])
        elif suffix == "npz":
            write_particles(path, positions, state.features[0].float().cpu().numpy()[there], colors[there])
        else:
            write_glb(path, positions, colors[there])
        return path

    def film(self, frames: UInt8[NDArray, "time height width 3"], fps: float, suffix: str = "webm") -> Path:
        """Write a film in one of ``FILM_FORMATS``."""
        path = self.free("rollout", suffix)
        write_video(path, frames, fps)
        return path

    def picture(self, image: UInt8[NDArray, "height width 3"]) -> Path:
        """Write a picture as PNG."""
        path = self.free("picture", "png")
        write_png(path, image)
        return path

    def camera_path(self, cameras: Cameras, fps: float) -> Path:
        """Write a camera path (axis: place) in nerfstudio's JSON, as ``vpd-render camera=FILE`` reads it.

        Raises:
            EditError: it has no places.
        """
        if not len(cameras.intrinsics):
            raise EditError("The camera path has no places.\nAdd the view of the browser first.")
        path = self.free("camera_path", "json")
        write_camera_path(path, cameras, fps, is_cycle=False)
        return path

    def edit(self, operations: Sequence[Operation]) -> Path:
        """Write the edits as YAML.

        Raises:
            EditError: nothing was edited.
        """
        if not operations:
            raise EditError("Nothing was edited so far.")
        return save_edit(self.free("edit", "yaml"), operations)


def as_pose(wxyz: NDArray[np.floating], position: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a quaternion (w, x, y, z) and a place."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    w, x, y, z = np.asarray(wxyz, dtype=np.float64)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = position
    return pose
