"""Deformable Block, Multi and Collision: soft bodies are dropped onto a floor."""

from data_gen.deformable.scene import DeformableScene as Scene
from data_gen.deformable.settings import DeformableSettings as Settings

VERSION = 1  # raise it whenever the same settings would give other data

__all__ = ["VERSION", "Scene", "Settings"]
