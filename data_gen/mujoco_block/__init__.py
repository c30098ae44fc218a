"""MuJoCo Block: one block with six colours is tossed onto a floor."""

from data_gen.mujoco_block.scene import MujocoBlockScene as Scene
from data_gen.mujoco_block.settings import MujocoBlockSettings as Settings

VERSION = 1  # raise it whenever the same settings would give other data

__all__ = ["VERSION", "Scene", "Settings"]
