"""Bounded and checked reading of HDF5 files: strangers' files may be damaged or hostile."""
