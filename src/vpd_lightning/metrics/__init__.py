"""Stage 5b: numbers that judge images, point sets and motion; ``registry.py`` lists them all."""
