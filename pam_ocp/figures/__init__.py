"""All figures, one look."""
