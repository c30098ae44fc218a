"""MuJoCo Block: a block with six colours is tossed onto a floor; RGB-D cameras watch from a half sphere.

Physics by MuJoCo; pictures by GL (``data_gen.gl``) or by ray casting without GL (``data_gen.raycast``). The paper gives
counts, frames, views, resolution and workspace; everything else (block size, friction, frame time, camera radius, field
of view) is ours, see the comments in ``conf/data_gen/mujoco_block/``.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.mujoco_block_settings import CameraSettings, MujocoBlockSettings
from vpd_lightning.data import schema

VERSION = 1  # raise it whenever the same settings would give other data
SPLIT_CODES = {"train": 0, "validation": 1, "test": 2}
GL_TO_CV = np.diag([1.0, -1.0, -1.0])  # between OpenGL (x right, y up, z back) and OpenCV (x right, y down, z forward)
BLOCK_GEOM_GROUP = 1


Settings = MujocoBlockSettings


def camera_positions(settings: CameraSettings) -> NDArray[np.float64]:
    """Return camera centres (view, 3): a golden-angle spiral, even in area between the two elevations."""
    index = np.arange(settings.num_views) + 0.5
    low, high = np.sin(np.radians([settings.elevation_min, settings.elevation_max]))
    z = low + (high - low) * index / settings.num_views
    azimuth = index * math.pi * (3.0 - math.sqrt(5.0))
    if settings.num_views <= 8:  # few cameras: even in azimuth, elevations alternating
        azimuth = index * 2 * math.pi / settings.num_views
        z = low + (high - low) * ((index * 0.618034) % 1.0)
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)
    return np.asarray(settings.target) + settings.radius * directions


def camera_poses(settings: CameraSettings) -> NDArray[np.float64]:
    """Return cam_to_world (view, 4, 4), OpenCV axes: z towards the target, x level."""
    poses = np.tile(np.eye(4), (settings.num_views, 1, 1))
    for pose, eye in zip(poses, camera_positions(settings), strict=True):
        forward = np.asarray(settings.target) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
    return poses


def camera_intrinsics(settings: CameraSettings) -> NDArray[np.float64]:
    """Return intrinsics (view, 3, 3) in pixels: square pixels, centred, pixel centres at +0.5."""
    focal = 0.5 * settings.height / math.tan(math.radians(settings.field_of_view) / 2)
    matrix = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1.0]])
    return np.tile(matrix, (settings.num_views, 1, 1))


def scene_xml(settings: MujocoBlockSettings) -> str:
    """Return the MJCF model: floor (geom 0), block (geom 1, group 1, free joint), cameras, one directional light."""
    cameras = []
    for view, pose in enumerate(camera_poses(settings.camera)):
        axes = pose[:3, :3] @ GL_TO_CV
        cameras.append(
            f'<camera name="view{view}" pos="{_text(pose[:3, 3])}" fovy="{settings.camera.field_of_view!r}"'
            f' xyaxes="{_text(np.concatenate([axes[:, 0], axes[:, 1]]))}"/>'
        )
    half, size, light = settings.block.side / 2, settings.floor.half_size, settings.light
    msaa = settings.supersampling**2 if settings.supersampling > 1 else 0
    return f"""
<mujoco model="mujoco_block">
  <option timestep="{settings.timestep!r}" integrator="implicitfast"/>
  <visual>
    <global offwidth="{settings.camera.width}" offheight="{settings.camera.height}"/>
    <quality shadowsize="1024" offsamples="{msaa}"/>
    <map znear="0.02" zfar="{4 * settings.far!r}" shadowclip="{2 * size!r}"/>
    <headlight active="1" ambient="{_text([light.ambient] * 3)}" diffuse="0 0 0" specular="0 0 0"/>
    <rgba haze="{_text(settings.floor.background)} 1"/>
  </visual>
  <statistic extent="1" center="0 0 0"/>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48" rgb1="{_text(settings.floor.background)}"
      rgb2="{_text(settings.floor.background)}"/>
    <texture name="floor" type="2d" builtin="flat" width="64" height="64" rgb1="1 1 1"/>
    <texture name="block" type="cube" builtin="flat" width="8" height="48" rgb1="1 1 1" rgb2="1 1 1"/>
    <material name="floor" texture="floor" texuniform="true" specular="0" shininess="0"
      texrepeat="{1 / settings.floor.tile!r} {1 / settings.floor.tile!r}"/>
    <material name="block" texture="block" specular="0" shininess="0"/>
  </asset>
  <worldbody>
    <light directional="true" castshadow="true" pos="{_text(-2 * np.asarray(light.direction))}"
      dir="{_text(light.direction)}" ambient="0 0 0" diffuse="{_text([light.diffuse] * 3)}" specular="0 0 0"/>
    <geom name="floor" type="plane" size="{size!r} {size!r} 0.05" material="floor"
      friction="{settings.block.friction!r}"/>
    <body name="block" pos="0 0 1">
      <freejoint/>
      <geom name="block" type="box" size="{half!r} {half!r} {half!r}" mass="{settings.block.mass!r}" material="block"
        group="{BLOCK_GEOM_GROUP}" friction="{settings.block.friction!r}"/>
    </body>
    {"".join(cameras)}
  </worldbody>
</mujoco>"""


def _text(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(repr(float(value)) for value in values)


def toss(settings: MujocoBlockSettings, seed: int, split: str, index: int) -> tuple[NDArray[np.float64], ...]:
    """Return the initial ``(qpos (7), qvel (6))``; depends on seed, split and index alone."""
    generator = np.random.default_rng([seed, SPLIT_CODES[split], index])
    ranges = settings.toss
    position = generator.uniform(ranges.position_min, ranges.position_max)
    quaternion = generator.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    velocity = generator.uniform(-1, 1, 3) * ranges.velocity_max
    angular_velocity = generator.uniform(-1, 1, 3) * ranges.angular_velocity_max
    return np.concatenate([position, quaternion]), np.concatenate([velocity, angular_velocity])


class MujocoBlockScene:
    """Simulates and renders trajectories; build one per process (a GL context belongs to one process)."""

    def __init__(self, settings: MujocoBlockSettings, renderer: str) -> None:
        import mujoco

        self.settings = settings
        self.model = mujoco.MjModel.from_xml_string(scene_xml(settings))
        self.data = mujoco.MjData(self.model)
        self.intrinsics = camera_intrinsics(settings.camera)
        self.cam_to_world = camera_poses(settings.camera)
        self.engine = f"mujoco {mujoco.__version__}, {renderer}"
        if renderer == "raycast":
            from data_gen.raycast import RaycastRenderer

            self.renderer: Any = RaycastRenderer(settings, self.model, self.intrinsics, self.cam_to_world)
        else:
            from data_gen.gl import GLRenderer

            self.renderer = GLRenderer(settings, self.model)

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def trajectory(
        self, seed: int, split: str, index: int, scene_hash: str, check_stop: Callable[[], None] = lambda: None
    ) -> schema.Trajectory:
        """Simulate and render one trajectory; ``check_stop`` is called before each frame and may raise."""
        import mujoco

        settings, model, data = self.settings, self.model, self.data
        camera, num_frames = settings.camera, settings.num_frames
        images = (num_frames, camera.num_views, camera.height, camera.width)
        rgb, depth = np.empty((*images, 3), np.uint8), np.empty(images, np.float32)
        segmentation = np.empty(images, np.uint8)
        positions, linear, angular = (np.empty((num_frames, 1, 3)) for _ in range(3))
        quaternions = np.empty((num_frames, 1, 4))
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = toss(settings, seed, split, index)
        mujoco.mj_forward(model, data)
        for frame in range(num_frames):
            check_stop()
            if frame:
                mujoco.mj_step(model, data, settings.substeps)
                mujoco.mj_forward(model, data)  # poses of this very moment, not of one physics step ago
            positions[frame, 0], quaternions[frame, 0] = data.qpos[:3], data.qpos[3:7]
            linear[frame, 0] = data.qvel[:3]
            angular[frame, 0] = data.xmat[1].reshape(3, 3) @ data.qvel[3:]  # MuJoCo gives it in the body frame
            self.renderer.render(data, rgb[frame], depth[frame], segmentation[frame])
        return schema.Trajectory(
            rgb=rgb,
            depth=depth,
            intrinsics=self.intrinsics,
            cam_to_world=self.cam_to_world,
            frame_time=settings.frame_time,
            near=settings.near,
            far=settings.far,
            workspace_min=tuple(settings.workspace_min),  # type: ignore[arg-type]
            workspace_max=tuple(settings.workspace_max),  # type: ignore[arg-type]
            seed=seed,
            engine=self.engine,
            scene_hash=scene_hash,
            attributes={"split": split, "index": index},
            state={
                schema.STATE_POSITIONS: positions,
                schema.STATE_QUATERNIONS: quaternions,
                schema.STATE_LINEAR_VELOCITIES: linear,
                schema.STATE_ANGULAR_VELOCITIES: angular,
                schema.STATE_HALF_SIZES: np.full((1, 3), settings.block.side / 2),
                schema.STATE_SEGMENTATION: segmentation,
            },
        )


Scene = MujocoBlockScene
