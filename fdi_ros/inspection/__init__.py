"""What is in a recording, and a config to start from."""
