"""Report of the step defects."""
