"""What a mounting of gyros can tell."""
