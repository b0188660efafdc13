"""What the sensors are: their axes, their errors, one block of their samples."""
