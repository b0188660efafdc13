"""Recorded data: reading and writing bags, replaying them through the pipeline."""
