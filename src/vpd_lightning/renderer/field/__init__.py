"""From features and positions to colour and density."""
