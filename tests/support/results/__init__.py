"""Results and records made by hand."""
