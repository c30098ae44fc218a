"""Pictures by Blender's path tracer (Cycles, CPU): soft shadows, light bounced between surfaces, gloss.

The physics, the cameras and what is visible stay MuJoCo's; Blender only draws (see ``docs/blender.md``).
"""

import zlib
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from data_gen.blender.extraction import AbstractScene, extract
from data_gen.blender.process import BlenderProcess, shared_process
from data_gen.labels import Labels
from data_gen.scene_settings import CameraSettings

USE_DENOISER = True  # at 16 samples it comes as near to the converged picture as twice the samples, at the same cost
_BOUNCES = 3
_SCENE_TIMEOUT = 300.0  # s
_VIEW_TIMEOUT = 300.0  # s per view of a frame


class BlenderRenderer:
    """Renders the cameras ``view0``, ``view1``, ... of a model; same interface as ``GLRenderer``.

    Blender runs in one child process per worker, which outlives the renderer and serves the next one.
    """

    def __init__(
        self,
        model: Any,
        camera: CameraSettings,
        labels: Labels,
        samples: int,
        use_denoiser: bool = USE_DENOISER,
    ) -> None:
        self.model = model
        self.camera_ids = [model.camera(f"view{view}").id for view in range(camera.num_views)]
        self.abstract = AbstractScene(model)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.extraction = extract(self.abstract, data, self.camera_ids)
        self.head = self.extraction.head | {
            "kind": "scene",
            "width": camera.width,
            "height": camera.height,
            "samples": samples,
            "denoise": use_denoiser,
            "bounces": _BOUNCES,
            "threads": 1,  # workers are the parallelism; pictures do not depend on it
        }
        values = {mujoco.mjtObj.mjOBJ_GEOM: labels.geoms, mujoco.mjtObj.mjOBJ_FLEX: labels.flexes}
        self.label_of_index = np.zeros(len(self.extraction.drawn) + 1, np.uint8)
        for number, drawn in enumerate(self.extraction.drawn):
            if drawn.object_type in values:
                self.label_of_index[number + 1] = values[mujoco.mjtObj(drawn.object_type)][drawn.object_id]
        self.name = f"blender {self._send_scene().version}, {samples} samples"

    def close(self) -> None:
        """Forget the scene; Blender stays for the next renderer of this process."""

    def render(
        self, data: Any, rgb: NDArray[np.uint8], depth: NDArray[np.float32], segmentation: NDArray[np.uint8]
    ) -> None:
        """Fill ``rgb`` (view, height, width, 3), ``depth`` (metres, 0 = nothing) and ``segmentation``.

        Raises:
            RenderingBackendError: Blender died, failed or did not answer.
        """
        arrays = self._frame(data)
        content = zlib.crc32(b"".join(array.tobytes() for array in arrays.values()))
        # Noise that depends on nothing but what is seen: the same in every run, another in every frame and view.
        seeds = [(content + 7919 * view) % (1 << 31) for view in range(len(self.camera_ids))]
        process = self._send_scene()
        timeout = _VIEW_TIMEOUT * len(self.camera_ids)
        _, pictures = process.ask({"kind": "frame", "seeds": seeds}, arrays, timeout)
        rgb[:], depth[:] = pictures["rgb"], pictures["depth"]
        segmentation[:] = self.label_of_index[pictures["index"]]

    def _send_scene(self) -> BlenderProcess:
        process = shared_process()
        if process.owner is not self:
            process.owner = None
            process.ask(self.head, self.extraction.arrays, _SCENE_TIMEOUT)
            process.owner = self
        return process

    def _frame(self, data: Any) -> dict[str, NDArray[np.float32]]:
        """Return where everything is."""
        drawn = self.extraction.drawn
        arrays: dict[str, NDArray[np.float32]] = {}
        positions, rotations = np.zeros((len(drawn), 3), np.float32), np.zeros((len(drawn), 9), np.float32)
        if self.model.nflex:
            self.abstract.update(data)
        for number, item in enumerate(drawn):
            if item.object_type == mujoco.mjtObj.mjOBJ_FLEX:
                arrays[f"object{number}.vertices"], arrays[f"object{number}.normals"] = self.abstract.skin(
                    item.object_id
                )
            elif item.object_type == mujoco.mjtObj.mjOBJ_SITE:
                positions[number], rotations[number] = data.site_xpos[item.object_id], data.site_xmat[item.object_id]
            else:
                positions[number], rotations[number] = data.geom_xpos[item.object_id], data.geom_xmat[item.object_id]
        arrays |= {
            "positions": positions,
            "rotations": rotations.reshape(-1, 3, 3),
            "camera_positions": np.asarray(data.cam_xpos)[self.camera_ids].astype(np.float32),
            "camera_rotations": np.asarray(data.cam_xmat)[self.camera_ids].reshape(-1, 3, 3).astype(np.float32),
        }
        return arrays
