"""A recording through the pipeline: run, evaluated, written, reported."""
