"""What one trial of a study does: one protocol a file."""
