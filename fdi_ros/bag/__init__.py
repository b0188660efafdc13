"""Recordings: opened, read in bounded memory whatever they hold, and decoded to samples."""
