"""Monte-Carlo studies of detectors."""
