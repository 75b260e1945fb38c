"""results.json: its content, and the names of the files of a folder of results."""
