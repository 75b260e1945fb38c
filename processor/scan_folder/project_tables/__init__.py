"""Single tables of project.toml."""
