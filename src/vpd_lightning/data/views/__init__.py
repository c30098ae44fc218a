"""Single-view clips and stored slots, for SAVi and SlotFormer."""
