"""The paper written plainly in PyTorch, with our weights and without our tricks: what speed is compared with."""
