"""Report of the step stitch."""
