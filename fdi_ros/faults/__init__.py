"""Faults of gyros, and their injection into samples and messages."""
