"""A field check: what targets that are seen from several places say of a scanner's errors."""
