"""Compiled searches and sums of the renderers, each beside its plain PyTorch form."""
