"""MuJoCo Block: a block with six colours is tossed onto a floor; RGB-D cameras watch from a half sphere.

Physics by MuJoCo; pictures by GL (``data_gen.gl``) or by ray casting without GL (``data_gen.raycast``). The paper gives
counts, frames, views, resolution and workspace; everything else (block size, friction, frame time, camera radius, field
of view) is ours, see the comments in ``conf/data_gen/mujoco_block/``.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import camera_intrinsics, camera_poses, camera_xml
from data_gen.cameras import mjcf_numbers as _text
from data_gen.labels import Labels
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.renderers import Renderer, open_renderer
from data_gen.rigid_bodies import RigidBodies
from data_gen.settings import SPLIT_CODES
from data_gen.simulate_and_render import simulate_and_render, trajectory_of
from data_gen.stage_clock import StageClock
from vpd_lightning.data import schema

BLOCK_GEOM_GROUP = 1


def scene_xml(settings: MujocoBlockSettings) -> str:
    """Return the MJCF model: floor (geom 0), block (geom 1, group 1, free joint), cameras, one directional light."""
    half, size, light = settings.block.side / 2, settings.floor.half_size, settings.light
    return f"""
<mujoco model="mujoco_block">
  <option timestep="{settings.timestep!r}" integrator="implicitfast"/>
  <visual>
    <global offwidth="{settings.camera.width}" offheight="{settings.camera.height}"/>
    <quality shadowsize="1024" offsamples="{settings.num_multisamples}"/>
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
    <geom name="floor" type="plane" size="{size!r} {size!r} {size!r}" material="floor"
      friction="{settings.block.friction!r}"/>
    <body name="block" pos="0 0 1">
      <freejoint/>
      <geom name="block" type="box" size="{half!r} {half!r} {half!r}" mass="{settings.block.mass!r}" material="block"
        group="{BLOCK_GEOM_GROUP}" friction="{settings.block.friction!r}"/>
    </body>
    {camera_xml(settings.camera)}
  </worldbody>
</mujoco>"""


def initial_state(settings: MujocoBlockSettings, seed: int, split: str, index: int) -> tuple[NDArray[np.float64], ...]:
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
        self.renderer = self._open(renderer)
        self.engine = f"mujoco {mujoco.__version__}, {self.renderer.name}"

    def _open(self, renderer: str) -> Renderer:
        camera = self.settings.camera
        if renderer == "raycast":
            from data_gen.mujoco_block.raycast import RaycastRenderer

            return RaycastRenderer(self.settings, self.model, camera_intrinsics(camera), camera_poses(camera))
        from data_gen.mujoco_block.textures import paint_textures

        paint_textures(self.settings, self.model)
        geoms = np.array([0, 1], np.uint8)  # floor, block
        return open_renderer(renderer, self.model, self.settings, Labels(geoms, np.empty(0, np.uint8)))

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def trajectory(
        self,
        seed: int,
        split: str,
        index: int,
        scene_hash: str,
        check_stop: Callable[[], None] = lambda: None,
        clock: StageClock | None = None,
    ) -> schema.Trajectory:
        """Simulate and render one trajectory; ``check_stop`` is called before each frame and may raise."""
        import mujoco

        settings, model, data = self.settings, self.model, self.data
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = initial_state(settings, seed, split, index)
        bodies = RigidBodies(data, num_bodies=1, num_frames=settings.num_frames)
        pictures = simulate_and_render(
            settings, model, data, self.renderer, clock or StageClock(), check_stop, bodies.observe
        )
        return trajectory_of(
            settings,
            pictures,
            state=bodies.state(half_sizes=np.full((1, 3), settings.block.side / 2)),
            seed=seed,
            engine=self.engine,
            scene_hash=scene_hash,
            attributes={"split": split, "index": index},
        )
