"""Simulated sensors: what a depth camera makes of true colours and depth."""

from vpd_lightning.data.sensors.sensor import Sensor
from vpd_lightning.data.sensors.settings import SensorSettings, load_sensor, sensor_names

__all__ = ["Sensor", "SensorSettings", "load_sensor", "sensor_names"]
