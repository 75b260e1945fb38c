"""Report of the step inspect."""
