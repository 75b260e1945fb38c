"""Files, folders and bytes of inputs."""
