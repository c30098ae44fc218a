"""MOVi-like scenes: several objects are thrown onto a floor under a dome."""

from data_gen.movi.scene import MoviScene as Scene
from data_gen.movi.settings import MoviSettings as Settings

VERSION = 1  # raise it whenever the same settings would give other data

__all__ = ["VERSION", "Scene", "Settings"]
