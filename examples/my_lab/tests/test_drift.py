from my_lab.drift import DriftDynamics
from vpd_lightning.testing import DynamicsContract


class TestDrift(DynamicsContract):
    def build(self):
        return DriftDynamics(feature_dim=self.feature_dim, hidden_dim=8, match_scale=0.05, location_scale=0.1)
