"""Faults of many kinds and sizes in the user's own recording."""
