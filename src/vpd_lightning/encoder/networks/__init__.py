"""Convolutional networks of the encoders."""
