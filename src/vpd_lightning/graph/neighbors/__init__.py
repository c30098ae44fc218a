"""Neighbour search: ``knn`` and ``radius``, with one module per backend and brute force as the definition."""

from vpd_lightning.graph.neighbors.automatic import automatic_backend
from vpd_lightning.graph.neighbors.contract import Neighbors
from vpd_lightning.graph.neighbors.search import BACKENDS, PointIndex, knn, radius

__all__ = ["BACKENDS", "Neighbors", "PointIndex", "automatic_backend", "knn", "radius"]
