"""r2s: real-to-sim for fabrics."""
