"""Other conventions that people use for poses, depth and intrinsics, as conversions to ours."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from data_gen.inspection.posed_depth import Array, PosedDepth

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_AXES = {
    "opencv": "",
    "opengl": "the camera axes are OpenGL's (y up, z back): multiply cam_to_world by diag(1, -1, -1, 1)",
    "inverted": "cam_to_world is world_to_cam: invert it",
    "inverted_opengl": "cam_to_world is world_to_cam with OpenGL axes: invert it, then multiply by diag(1, -1, -1, 1)",
    "turned_back": "the rotation in cam_to_world is world_to_cam's: transpose it",
}
_DEPTHS = {
    0: "",
    -1: "depth is the distance to the camera centre: divide it by the length of the ray (x/z, y/z, 1)",
    1: "depth was z and has been divided by the length of the ray: multiply it by that again",
}
_SCALES = {
    1.0: "",
    1e-3: "depth is in millimetres: divide it by 1000",
    1e3: "depth is 1000 times too small (metres taken for millimetres): multiply it by 1000",
}
# Steps of 0.1, 0.2 (TUM), 0.25, 0.4, 2.5, 4, 5 and 10 mm taken for each other or for millimetres.
_STEPS = (0.1, 0.2, 0.25, 0.4, 2.5, 4.0, 5.0, 10.0)
_UNITS = {step: f"depth is in another unit: multiply it by {step:g}" for step in _STEPS}
_TRANSLATIONS = {1.0: "", 1e-3: "the positions in cam_to_world are in millimetres: divide them by 1000"}
_SHIFTS = {
    0.0: "",
    0.5: "the principal point is for pixel centres at whole numbers: add 0.5 to cx and cy",
    -0.5: "the principal point has 0.5 too much (added twice?): subtract 0.5 from cx and cy",
}


@dataclass(frozen=True)
class CameraConvention:
    """One way to read a file; the default is what the format prescribes.

    ``ray_power`` multiplies depth by that power of the ray's length; the scales multiply depth and camera positions;
    ``pixel_shift`` is added to the principal point.
    """

    axes: str = "opencv"
    ray_power: int = 0
    depth_scale: float = 1.0
    translation_scale: float = 1.0
    pixel_shift: float = 0.0

    @property
    def changes(self) -> tuple[str, ...]:
        """What is different from the prescribed convention, each with its remedy."""
        texts = (
            _AXES[self.axes],
            _DEPTHS[self.ray_power],
            {**_SCALES, **_UNITS}[self.depth_scale],
            _TRANSLATIONS[self.translation_scale],
            _SHIFTS[self.pixel_shift],
        )
        return tuple(text for text in texts if text)

    def __str__(self) -> str:
        return "; and ".join(self.changes) or "as stored"

    def pose(self, cam_to_world: Array) -> Array:
        """Return cam_to_world in our convention from one that was meant like this."""
        pose: Array = cam_to_world.copy()
        pose[:3, 3] *= self.translation_scale
        if self.axes.startswith("inverted"):
            pose = np.linalg.inv(pose).astype(np.float64)
        if self.axes == "turned_back":
            pose[:3, :3] = pose[:3, :3].T.copy()
        return pose @ _FLIP if self.axes.endswith("opengl") else pose

    def intrinsics(self, matrix: Array) -> Array:
        """Return the intrinsics in our convention."""
        shifted = matrix.copy()
        shifted[:2, 2] += self.pixel_shift
        return shifted

    def z_depth(self, depth: Array, rays: Array | None) -> Array:
        """Return z-depth in metres of values that were meant like this, seen along ``rays`` (one unit of z long).

        Without a ``ray_power`` the rays do not matter.
        """
        scaled = depth * self.depth_scale
        if rays is None or self.ray_power == 0:
            return scaled
        return scaled * np.linalg.norm(rays, axis=-1) ** self.ray_power

    def read(self, image: PosedDepth) -> PosedDepth:
        """Return the whole image in our convention."""
        intrinsics = self.intrinsics(image.intrinsics)
        height, width = image.depth.shape
        y = (np.arange(height)[:, None] + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
        x = (np.arange(width)[None, :] + 0.5 - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
        rays = np.stack(np.broadcast_arrays(x, y, np.ones(())), axis=-1)
        depth = self.z_depth(image.depth.astype(np.float64), rays).astype(np.float32)
        return PosedDepth(depth, intrinsics, self.pose(image.cam_to_world))


STORED = CameraConvention()


def single_mistakes() -> list[CameraConvention]:
    """Conventions that differ from the prescribed one in a single thing."""
    return [convention for convention in without_shift() if len(convention.changes) == 1] + with_shifts(STORED)


def without_shift() -> list[CameraConvention]:
    """All combinations except those of the principal point."""
    conventions = [
        CameraConvention(axes, ray_power, depth_scale)
        for axes, ray_power, depth_scale in itertools.product(_AXES, _DEPTHS, _SCALES)
    ]
    conventions += [CameraConvention(depth_scale=scale) for scale in _UNITS]
    # To views alone, positions that are too large look like depths that are too small.
    return conventions + [
        replace(r, depth_scale=1.0, translation_scale=1e-3) for r in conventions if r.depth_scale == 1e3
    ]


def with_shifts(convention: CameraConvention) -> list[CameraConvention]:
    """The same convention with the principal point half a pixel further, and nearer."""
    return [replace(convention, pixel_shift=shift) for shift in _SHIFTS if shift]
