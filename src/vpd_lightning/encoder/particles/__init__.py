"""From pixels with depth to the particles of a scene."""
