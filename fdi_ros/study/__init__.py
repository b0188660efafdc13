"""What is known about it offline: simulation, faults, evaluation, reports."""
