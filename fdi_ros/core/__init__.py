"""The sample path: records of fixed size and compiled functions over them, one sample at a time."""
