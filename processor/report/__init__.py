"""Report of a run: tables, pictures, the page; a folder for the package of each step."""
