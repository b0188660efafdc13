"""A recording through the pipeline: run, evaluated, checked, written, reported."""
