"""Scripts of the pages, and what puts them there."""
