"""Samples and candidates along rays, and compositing."""
