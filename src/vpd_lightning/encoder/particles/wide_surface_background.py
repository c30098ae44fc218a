"""What stands still, found from one frame: wide smooth surfaces. No fixed cameras, no training."""

import hashlib
from collections import OrderedDict

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from vpd_lightning.encoder.base import AbstractBackground
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.noisy_planes import off_wide_planes, relative_noise
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.geometry.wide_surfaces import wide_surfaces
from vpd_lightning.types import Cameras, RGBDFrames


class WideSurfaceBackground(AbstractBackground):
    """Marks pixels that belong to no wide smooth surface as what may move; see ``geometry.wide_surfaces``.

    A body is smaller than what it lies on. So a body at rest, which may be struck later, is found as well
    as one in flight, and its shadow is not taken for a body. ``max_slope`` and ``max_turn_degrees`` say how smooth,
    ``min_width`` (a share of all that is seen) how wide, ``tolerance`` (in pixels) how close to a surface is on it.

    Where depth scatters by more than ``noise_floor`` (a share of it, found from the frame itself, camera by camera;
    null: never looked at) normals of neighbouring pixels are unreliable, and planes fitted to all views replace
    surfaces: see ``geometry.noisy_planes``. Below it nothing is different from a perfect sensor.

    The masks of the last ``memory_frames`` time steps are kept, in packed bits, by a digest of depth and cameras: a
    training sees each frame many times. Kept or computed, they are the same.
    """

    # Paper: not in the paper; it gives the inertial dynamics its candidates for motion. Region growing over smooth
    # neighbours is that of Rabbani et al. 2006 ("Segmentation of point clouds using smoothness constraint").

    def __init__(
        self,
        *,
        max_slope: float,
        max_turn_degrees: float,
        min_width: float,
        tolerance: float,
        memory_frames: int,
        noise_floor: float | None,
    ):
        super().__init__()
        if not 0 < max_turn_degrees < 90:
            raise ValueError(f"max_turn_degrees must lie between 0 and 90, got {max_turn_degrees}")
        for name, value in (("max_slope", max_slope), ("min_width", min_width)):
            if not 0 < value < 1:
                raise ValueError(f"{name} must lie between 0 and 1, got {value}")
        if noise_floor is not None and not 0 < noise_floor < 1:
            raise ValueError(f"noise_floor must lie between 0 and 1, or be null, got {noise_floor}")
        if tolerance < 0 or memory_frames < 0:
            raise ValueError(
                f"tolerance and memory_frames must not be negative, got tolerance={tolerance}, "
                f"memory_frames={memory_frames}"
            )
        self.max_slope, self.max_turn = max_slope, float(np.cos(np.radians(max_turn_degrees)))
        self.min_width, self.tolerance, self.memory_frames = min_width, tolerance, memory_frames
        self.noise_floor = noise_floor
        self._memory: OrderedDict[bytes, np.ndarray] = OrderedDict()

    @torch.no_grad()
    def forward(self, frames: RGBDFrames) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels may be moving."""
        members = [self._member(frames[member]) for member in range(len(frames.depth))]
        return torch.stack(members).to(frames.depth.device)

    def _member(self, frames: RGBDFrames) -> Tensor:
        key, shape = _digest(frames), frames.depth.shape
        packed = self._memory.get(key)
        if packed is None:
            packed = np.packbits(self._loose(frames))
            self._memory[key] = packed
            while len(self._memory) > self.memory_frames:
                self._memory.popitem(last=False)
        else:
            self._memory.move_to_end(key)
        return torch.from_numpy(np.unpackbits(packed, count=shape.numel()).astype(bool).reshape(tuple(shape)))

    def _loose(self, frames: RGBDFrames) -> np.ndarray:
        frames = frames.to("cpu", torch.float32)
        depth = torch.nan_to_num(frames.depth, nan=0.0, posinf=0.0, neginf=0.0)
        valid = depth > 0
        if self.noise_floor is not None:
            noise = relative_noise(depth.double().numpy(), valid.numpy())
            if np.median(noise) > self.noise_floor:
                found = self._off_planes(depth, valid.numpy(), frames.cameras, noise)
                if found is not None:
                    return found
        intrinsics = frames.cameras.intrinsics
        focal = (intrinsics[..., 0, 0] + intrinsics[..., 1, 1]).expand(depth.shape[:1])[:, None, None] / 2
        normals = depth_normals(depth, frames.cameras).numpy()
        wide = wide_surfaces(
            unproject(depth, frames.cameras).numpy(),
            normals,
            valid.numpy(),
            (depth / focal).numpy(),
            max_slope=self.max_slope,
            max_turn=self.max_turn,
            min_width=self.min_width,
            tolerance=self.tolerance,
        )
        # Without a normal (image borders, single pixels) nothing is known; such pixels count as static.
        return valid.numpy() & ~wide & ((normals**2).sum(axis=-1) > 0.5)

    def _off_planes(
        self, depth: Tensor, valid: np.ndarray, cameras: Cameras, noise: np.ndarray
    ) -> Bool[np.ndarray, "view height width"] | None:
        intrinsics = cameras.intrinsics
        focal = (intrinsics[..., 0, 0] + intrinsics[..., 1, 1]).expand(len(depth)) / 2
        unit = unproject(torch.ones_like(depth), cameras).double().numpy()
        centers = cameras.cam_to_world[..., :3, 3].expand(len(depth), 3).double().numpy()
        return off_wide_planes(
            depth.numpy(),
            unit - centers[:, None, None],
            centers,
            valid,
            noise,
            (1 / focal).double().numpy(),
            min_width=self.min_width,
        )


def _digest(frames: RGBDFrames) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for values in (frames.depth, frames.cameras.intrinsics, frames.cameras.cam_to_world):
        digest.update(str((values.dtype, tuple(values.shape))).encode())
        digest.update(values.detach().cpu().contiguous().numpy().tobytes())
    return digest.digest()
