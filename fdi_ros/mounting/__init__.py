"""What a mounting of gyros can detect and isolate."""
