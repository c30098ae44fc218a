"""Pushing: a position-controlled pusher among one to four bodies on a table with an edge."""

from data_gen.pushing.scene import PushingScene as Scene
from data_gen.pushing.settings import PushingSettings as Settings

VERSION = 1  # raise it whenever the same settings would give other data

__all__ = ["VERSION", "Scene", "Settings"]
