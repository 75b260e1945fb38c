"""Single spheres: against the bound, beside peers, as they are in the field."""
