"""Scripts of the report page."""
