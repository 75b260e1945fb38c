"""Report of the step deviation."""
