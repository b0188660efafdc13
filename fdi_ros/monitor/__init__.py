"""What to do about it: health of each channel, decisions over time, the fused rate, the pipeline."""
