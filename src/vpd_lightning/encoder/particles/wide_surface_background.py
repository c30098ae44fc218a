"""What stands still, found from one frame: wide smooth surfaces. No fixed cameras, no training."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.encoder.base import AbstractBackground
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.hanging_points import hangs_alone
from vpd_lightning.geometry.local_planes import between_surfaces, plane_depth
from vpd_lightning.geometry.noisy_planes import off_wide_planes, relative_noise
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.geometry.wide_surfaces import wide_surfaces
from vpd_lightning.types import RGBDFrames

_MAX_BYTES = 2**29
"""Of smoothed depth that is kept."""


class WideSurfaceBackground(AbstractBackground):
    """Marks pixels that belong to no wide smooth surface as what may move; see ``geometry.wide_surfaces``.

    A body is smaller than what it lies on. So a body at rest, which may be struck later, is found as well
    as one in flight, and its shadow is not taken for a body. ``max_slope`` and ``max_turn_degrees`` say how smooth,
    ``min_width`` (a share of all that is seen) how wide, ``tolerance`` (in pixels) how close to a surface is on it.

    Where depth scatters by more than ``noise_floor`` (a share of it, found from the frame itself, camera by camera;
    null: never looked at) normals of neighbouring pixels are unreliable, and planes fitted to all views replace
    surfaces, and pixels that hang in the air between two surfaces are left out: see ``geometry.noisy_planes``. Depth
    is smoothed, and continued to pixels that were lost beside a surface: see ``geometry.local_planes``. Below the
    floor nothing is different from a perfect sensor.

    The masks of the last ``memory_frames`` time steps are kept, in packed bits, by a digest of depth and cameras: a
    training sees each frame many times. Kept or computed, they are the same. So is smoothed depth, half a gigabyte of
    it at most.
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
        self._trusted: OrderedDict[bytes, np.ndarray] = OrderedDict()
        self._in_the_air: OrderedDict[bytes, np.ndarray] = OrderedDict()
        self._restored: OrderedDict[bytes, np.ndarray | None] = OrderedDict()  # None: as measured

    @torch.no_grad()
    def forward(self, frames: RGBDFrames) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels may be moving."""
        members = [self._remembered(self._memory, frames[member], self._loose) for member in range(len(frames.depth))]
        return torch.stack(members).to(frames.depth.device)

    @torch.no_grad()
    def restored(
        self, frames: RGBDFrames
    ) -> tuple[Float[Tensor, "batch view height width"], Float[Tensor, "batch view height width"]]:
        """Return the depth (metres) by which it is judged what moves, and that which places the particles.

        The second is that of local planes where depth is noisy, where it is missing beside a surface, and where it
        hangs between two. What lies on a surface is judged as it was measured: thresholds follow from its noise.
        """
        if self.noise_floor is None:
            return frames.depth, frames.depth
        members = [frames[member] for member in range(len(frames.depth))]
        placed = torch.stack([self._restored_member(member) for member in members])
        hanging = torch.stack([self._remembered(self._in_the_air, member, self._hanging) for member in members])
        measured = torch.isfinite(frames.depth) & (frames.depth > 0)
        return torch.where(measured & ~hanging.to(placed.device), frames.depth, placed), placed

    def _hanging(self, frames: RGBDFrames) -> np.ndarray:
        depth, valid, noise = self._measured(frames.to("cpu", torch.float32))
        if noise is None:
            return np.zeros_like(valid)
        return between_surfaces(depth, torch.from_numpy(noise), torch.from_numpy(_pixel_sizes(frames))).numpy()

    def _restored_member(self, frames: RGBDFrames) -> Float[Tensor, "view height width"]:
        key, memory = _digest(frames, frames.rgb), self._restored
        if key in memory:
            memory.move_to_end(key)
        else:
            memory[key] = self._fitted_depth(frames)
            held = sum(depth.nbytes for depth in memory.values() if depth is not None)
            while len(memory) > 1 and (len(memory) > self.memory_frames or held > _MAX_BYTES):
                oldest = memory.popitem(last=False)[1]
                held -= 0 if oldest is None else oldest.nbytes
        found = memory[key]
        return frames.depth if found is None else torch.from_numpy(found).to(frames.depth)

    def _fitted_depth(self, frames: RGBDFrames) -> np.ndarray | None:
        rgb = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.float() / 255
        frames = replace(frames, rgb=rgb).to("cpu", torch.float32)
        depth, _, noise = self._measured(frames)
        if noise is None:
            return None
        noise, sizes = torch.from_numpy(noise).float(), torch.from_numpy(_pixel_sizes(frames)).float()
        hanging = between_surfaces(depth, noise, sizes)
        found = plane_depth(torch.where(hanging, 0.0, depth), frames.rgb, noise, sizes)
        return torch.where(hanging & (found == 0), depth, found).numpy()

    @torch.no_grad()
    def trusted(
        self, frames: RGBDFrames, moving: Bool[Tensor, "batch view height width"]
    ) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels measured a surface; in noisy depth some hang in the air between two."""
        if self.noise_floor is None:
            return super().trusted(frames, moving)
        members = [
            self._remembered(
                self._trusted, frames[member], partial(self._not_alone, moving=moving[member].cpu().numpy())
            )
            for member in range(len(frames.depth))
        ]
        return torch.stack(members).to(frames.depth.device)

    def _not_alone(self, frames: RGBDFrames, moving: np.ndarray) -> np.ndarray:
        """Return the valid pixels that move, and those of the others that have others near them."""
        frames = frames.to("cpu", torch.float32)
        depth, valid, noise = self._measured(frames)
        if noise is None:
            return valid
        points = unproject(depth, frames.cameras).numpy()
        return valid & ~hangs_alone(points, valid & ~moving, depth.numpy() * _pixel_sizes(frames)[:, None, None])

    def _measured(self, frames: RGBDFrames) -> tuple[Tensor, np.ndarray, np.ndarray | None]:
        """Return depth, where it is valid, and each view's noise; None where that is below the floor."""
        depth = torch.nan_to_num(frames.depth, nan=0.0, posinf=0.0, neginf=0.0)
        valid = (depth > 0).numpy()
        if self.noise_floor is None:
            return depth, valid, None
        noise = relative_noise(depth.double().numpy(), valid)
        return depth, valid, noise if np.median(noise) > self.noise_floor else None

    def _remembered(
        self, memory: OrderedDict[bytes, np.ndarray], frames: RGBDFrames, find: Callable[[RGBDFrames], np.ndarray]
    ) -> Tensor:
        key, shape = _digest(frames), frames.depth.shape
        packed = memory.get(key)
        if packed is None:
            packed = np.packbits(find(frames))
            memory[key] = packed
            while len(memory) > self.memory_frames:
                memory.popitem(last=False)
        else:
            memory.move_to_end(key)
        return torch.from_numpy(np.unpackbits(packed, count=shape.numel()).astype(bool).reshape(tuple(shape)))

    def _loose(self, frames: RGBDFrames) -> np.ndarray:
        frames = frames.to("cpu", torch.float32)
        depth, valid, noise = self._measured(frames)
        if noise is not None:
            found = self._off_planes(depth, valid, frames, noise)
            if found is not None:
                return found
        intrinsics = frames.cameras.intrinsics
        focal = (intrinsics[..., 0, 0] + intrinsics[..., 1, 1]).expand(depth.shape[:1])[:, None, None] / 2
        normals = depth_normals(depth, frames.cameras).numpy()
        wide = wide_surfaces(
            unproject(depth, frames.cameras).numpy(),
            normals,
            valid,
            (depth / focal).numpy(),
            max_slope=self.max_slope,
            max_turn=self.max_turn,
            min_width=self.min_width,
            tolerance=self.tolerance,
        )
        # Without a normal (image borders, single pixels) nothing is known; such pixels count as static.
        return valid & ~wide & ((normals**2).sum(axis=-1) > 0.5)

    def _off_planes(
        self, depth: Tensor, valid: np.ndarray, frames: RGBDFrames, noise: np.ndarray
    ) -> Bool[np.ndarray, "view height width"] | None:
        cameras = frames.cameras
        unit = unproject(torch.ones_like(depth), cameras).double().numpy()
        centers = cameras.cam_to_world[..., :3, 3].expand(len(depth), 3).double().numpy()
        return off_wide_planes(
            depth.numpy(),
            unit - centers[:, None, None],
            centers,
            valid,
            noise,
            _pixel_sizes(frames),
            min_width=self.min_width,
        )


def _pixel_sizes(frames: RGBDFrames) -> Float[np.ndarray, " view"]:
    """Return what a pixel of each view covers, as a share of its depth."""
    intrinsics = frames.cameras.intrinsics
    focal = (intrinsics[..., 0, 0] + intrinsics[..., 1, 1]).expand(len(frames.depth)) / 2
    return (1 / focal).double().numpy()


def _digest(frames: RGBDFrames, *others: Tensor) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for values in (frames.depth, frames.cameras.intrinsics, frames.cameras.cam_to_world, *others):
        digest.update(str((values.dtype, tuple(values.shape))).encode())
        digest.update(values.detach().cpu().contiguous().numpy().tobytes())
    return digest.digest()
