"""What every importer hands over: one recording in our conventions, whose images are read when they are written."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data_gen.importers.depth_registration import DepthCamera
from vpd_lightning.data.driven_motion import DrivenMotion
from vpd_lightning.data.manifest import SPLITS

MIN_FRAMES = 3  # two observed frames and one to predict


@dataclass(frozen=True)
class Recording:
    """One continuous recording, in our conventions but for lens distortion, which the writer removes.

    All recordings of a source are listed before the first image is read, so the two ``read`` functions must open what
    they need when they are called, and hold no pixels. They are called in order of time, all views of a frame together,
    from one thread; an interrupted import starts anywhere. They raise ``DataError`` naming the file that is broken.

    Attributes:
        name: unique within the source; becomes the attribute ``recording`` of every file cut from it.
        intrinsics: (view, 3, 3) or (time, view, 3, 3), pixels, pixel centres at +0.5, of the images as they are read.
        cam_to_world: (view, 4, 4) or (time, view, 4, 4), OpenCV camera axes.
        frame_time: seconds between frames.
        read_rgb: (frame, view) -> (height, width, 3), sRGB.
        read_depth: (frame, view) -> (height, width), depth along the optical axis (z) in metres, 0 = none. Where the
            source gives distances, convert them with ``conventions.distance_to_z`` and the view's distortion. Where the
            view has a depth camera of its own, its images as they are; the writer registers them to colour.
        source: what was found and converted, written as attributes ``source_<key>``. Keys: ``format``, ``axes``
            (``opencv``, ``opengl``, ...), ``depth_type`` (``z`` or ``distance``), ``depth_unit`` (metres per step),
            ``pixel_center`` (``0.5`` or ``0.0``), and whatever else a reader of the data should know.
        distortion: (view, 5) or (view, 8), OpenCV's k1 k2 p1 p2 k3 [k4 k5 k6]; ``None`` means none.
        split: ``train``, ``validation`` or ``test`` where the source says so.
        view_names: what the source calls its views; empty where they have no names.
        depth_cameras: one for each view, ``None`` where depth is aligned to colour; empty where all of it is.
        driven: what a robot did, in the source's world, one entry for each frame; ``None`` where nothing says so.
    """

    name: str
    height: int
    width: int
    intrinsics: NDArray[np.float64]
    cam_to_world: NDArray[np.float64]
    num_frames: int
    num_views: int
    frame_time: float
    read_rgb: Callable[[int, int], NDArray[np.uint8]]
    read_depth: Callable[[int, int], NDArray[np.float32]]
    source: Mapping[str, str] = field(default_factory=dict)
    distortion: NDArray[np.float64] | None = None
    split: str | None = None
    view_names: Sequence[str] = ()
    depth_cameras: Sequence[DepthCamera | None] = ()
    driven: DrivenMotion | None = None

    def __post_init__(self) -> None:
        time, view = self.num_frames, self.num_views
        for name, size in (("intrinsics", 3), ("cam_to_world", 4)):
            array = getattr(self, name)
            shapes = [(view, size, size), (time, view, size, size)]
            if array.dtype != np.float64 or array.shape not in shapes:
                raise ValueError(
                    f"{name} is {array.dtype} {array.shape}; it must be float64 {shapes[0]} or {shapes[1]}"
                )
        if self.distortion is not None and self.distortion.shape not in ((view, 5), (view, 8)):
            raise ValueError(f"distortion is {self.distortion.shape}; it must be ({view}, 5) or ({view}, 8)")
        for name in ("view_names", "depth_cameras"):
            if len(getattr(self, name)) not in (0, view):
                raise ValueError(f"{name} has {len(getattr(self, name))} entries; it must have none, or {view}")
        if self.split is not None and self.split not in SPLITS:
            raise ValueError(f"split is {self.split!r}; allowed: {', '.join(SPLITS)}")
        if not self.frame_time > 0:
            raise ValueError(f"frame_time is {self.frame_time}; it must be positive")

    def intrinsics_at(self, frame: int) -> NDArray[np.float64]:
        """Return (view, 3, 3) of one frame."""
        return self.intrinsics if self.intrinsics.ndim == 3 else self.intrinsics[frame]

    def depth_camera(self, view: int) -> DepthCamera | None:
        """Return the sensor of a view's depth, where it is not the colour camera."""
        return self.depth_cameras[view] if self.depth_cameras else None
